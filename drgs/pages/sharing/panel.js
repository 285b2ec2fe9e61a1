// The controls beside the picture: only those are there that the scene has something for.
const A_ROUND = 6; // seconds in which all times are played

const COLORS = "colors";
const CLASSES = "classes";

function element(tag, fields = {}, ...children) {
  const made = Object.assign(document.createElement(tag), fields);
  made.append(...children);
  return made;
}

export async function buildPanel({
  scene, gaussians, frusta, steering, goTo, changed, bytesOfPart, first, asked,
}) {
  const controls = document.getElementById("controls");
  const updates = []; // called once a picture
  document.getElementById("panel").open = innerWidth > 700;

  const times = scene.moments ? await moments(scene.moments, gaussians, bytesOfPart) : null;
  const time = times ? timeSlider(times, scene.moments, changed, updates) : null;

  const choice = element("select", { ariaLabel: "photograph" });
  const groups = { fitted: "photographs", next: "photographs to take next", other: "views" };
  for (const [kind, label] of Object.entries(groups)) {
    const photos = scene.photos.map((photo, i) => [photo, i]).filter(([photo]) => photo.kind === kind);
    if (photos.length) {
      const options = photos.map(([photo, i]) => element("option", { value: i, textContent: photo.name }));
      choice.append(element("optgroup", { label }, ...options));
    }
  }
  const choose = (photo) => {
    choice.value = scene.photos.indexOf(photo);
    goTo(photo);
    if (time && photo.time !== null) {
      time.set(photo.time);
    }
  };
  choice.addEventListener("change", () => {
    choose(scene.photos[choice.value]);
    document.getElementById("canvas").focus(); // arrow keys are for the camera again
  });
  controls.append(element("div", { className: "row" }, choice));

  const flying = element("button", { textContent: "fly", title: "drag turns the camera; W A S D E Q move it" });
  flying.setAttribute("aria-pressed", "false");
  flying.addEventListener("click", () => {
    steering.fly(!steering.isFlying);
    flying.setAttribute("aria-pressed", String(steering.isFlying));
  });
  const back = element("button", { textContent: "back to the photograph" });
  back.addEventListener("click", () => choose(scene.photos[choice.value]));
  controls.append(element("div", { className: "row" }, flying, " ", back));

  const shown = element("input", { type: "checkbox", checked: frusta.visible });
  shown.addEventListener("change", () => {
    frusta.visible = shown.checked;
    changed();
  });
  controls.append(element("label", {}, shown, " cameras, which a tap goes to"));

  if (time) {
    controls.append(time.row);
  }
  await layers({ scene, gaussians, controls, changed, bytesOfPart, asked });
  time?.set(scene.moments.times[0]); // where photographs without a time leave it
  choose(first);
  if (time && asked.has("time")) {
    time.set(Number(asked.get("time")));
  }
  return { choose, update: () => updates.forEach((update) => update()) };
}

// Colors of their own, of how wrong they are expected to be, of classes; and which classes are drawn.
async function layers({ scene, gaussians, controls, changed, bytesOfPart, asked }) {
  const tints = { [COLORS]: null };
  const legends = {};
  if (scene.scale) {
    const levels = await bytesOfPart("scale");
    tints[scene.scale.name] = lookedUp(levels, scene.scale.colors);
    legends[scene.scale.name] = scaleOf(scene.scale);
  }
  if (scene.classes) {
    const labels = new Uint16Array((await bytesOfPart(CLASSES)).buffer);
    tints[CLASSES] = lookedUp(labels, scene.classes.colors);
    const off = new Set();
    const rows = scene.classes.names.map((name, i) => {
      const box = element("input", { type: "checkbox", checked: true });
      box.addEventListener("change", () => {
        off[box.checked ? "delete" : "add"](i + 1);
        gaussians.hide((k) => off.has(labels[k]));
        changed();
      });
      const swatch = element("span", { className: "swatch" });
      swatch.style.background = `rgb(${scene.classes.colors[i + 1]})`;
      return element("label", {}, box, swatch, name);
    });
    controls.append(element("details", {}, element("summary", { textContent: CLASSES }), ...rows));
  }
  if (Object.keys(tints).length === 1) {
    return;
  }
  const choice = element("select", { ariaLabel: "layer" });
  choice.append(...Object.keys(tints).map((name) => element("option", { value: name, textContent: name })));
  const legend = element("div");
  const show = (name) => {
    choice.value = name;
    legend.replaceChildren(...(legends[name] ? [legends[name]] : []));
    gaussians.tint(tints[name]);
    changed();
  };
  choice.addEventListener("change", () => show(choice.value));
  controls.append(element("div", { className: "row" }, choice), legend);
  if (tints[asked.get("layer")]) {
    show(asked.get("layer"));
  }
}

// (N, 3) bytes: the color of each one's number.
function lookedUp(numbers, colors) {
  const found = new Uint8Array(3 * numbers.length);
  numbers.forEach((number, i) => found.set(colors[number], 3 * i));
  return found;
}

function scaleOf({ low, high, text, colors }) {
  const bar = element("div", { className: "scale" });
  bar.style.background = `linear-gradient(to right, ${colors.map((color) => `rgb(${color})`).join(", ")})`;
  const ends = element("div", { className: "soft" }, `${low.toPrecision(2)} to ${high.toPrecision(2)}: ${text}`);
  return element("div", {}, bar, ends);
}

// What moves, at the moments that the page has; between two of them on a straight line. What is there for a time alone
// drifts besides, and comes and goes.
async function moments({ times, count, low, high }, gaussians, bytesOfPart) {
  const places = new Uint32Array((await bytesOfPart("moving")).buffer);
  const codes = new Uint16Array((await bytesOfPart("moments")).buffer); // moment, number, Gaussian
  const lives = new Float32Array((await bytesOfPart("lives")).buffer); // number, Gaussian
  const value = (moment, number, k) => {
    const code = codes[(moment * 10 + number) * count + k];
    return low[number] + ((high[number] - low[number]) * code) / 65535;
  };
  return (time) => {
    const last = times.length - 1;
    let before = times.findLastIndex((x) => x <= time);
    before = Math.min(Math.max(before, 0), Math.max(last - 1, 0));
    const after = Math.min(before + 1, last);
    const span = times[after] - times[before];
    const share = span > 0 ? Math.min(Math.max((time - times[before]) / span, 0), 1) : 0;
    const at = (number, k) => (1 - share) * value(before, number, k) + share * value(after, number, k);
    gaussians.move(places, (k, center, scales, quaternion) => {
      center.set(at(0, k), at(1, k), at(2, k));
      scales.set(Math.exp(at(3, k)), Math.exp(at(4, k)), Math.exp(at(5, k)));
      quaternion.set(at(7, k), at(8, k), at(9, k), at(6, k)).normalize();
      const [middle, width, x, y, z, ax, ay, az, birth] =
        [0, 1, 2, 3, 4, 5, 6, 7, 8].map((number) => lives[number * count + k]);
      if (width === 0) return 1; // always there
      const ahead = time - birth;
      center.x += ahead * (x + 0.5 * ahead * ax);
      center.y += ahead * (y + 0.5 * ahead * ay);
      center.z += ahead * (z + 0.5 * ahead * az);
      return Math.exp(-0.5 * ((time - middle) / width) ** 2);
    });
  };
}

function timeSlider(setTime, { times }, changed, updates) {
  const [low, high] = [times[0], times[times.length - 1]];
  const slider = element("input", { type: "range", min: low, max: high, step: "any", ariaLabel: "time" });
  const play = element("button", { textContent: "play" });
  let started = null; // when, and at which time
  const set = (time) => {
    slider.value = time;
    setTime(Number(slider.value));
    changed();
  };
  slider.addEventListener("input", () => set(slider.value));
  play.addEventListener("click", () => {
    started = started ? null : [performance.now(), Number(slider.value)];
    play.textContent = started ? "stop" : "play";
  });
  updates.push(() => {
    if (started) {
      const seconds = (performance.now() - started[0]) / 1000;
      set(low + ((started[1] - low + (seconds / A_ROUND) * (high - low)) % (high - low)));
    }
  });
  return { set, row: element("div", { className: "row" }, slider, play) };
}
