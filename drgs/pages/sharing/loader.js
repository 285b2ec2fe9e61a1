// Unpacks the page's own modules and starts it. A page that is opened from disk may import no file beside it, so that
// every module is text in the page, packed by gzip, and an import map says which address of memory each name means.
"use strict";

const bytesOf = (text) => Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));

const unpacked = (text) =>
  new Response(new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("gzip")));

async function bytesOfPart(name) {
  const script = document.querySelector(`script.part[data-name="${name}"]`);
  const response = unpacked(script.textContent);
  script.remove(); // it is as large as what it holds, and read once
  return new Uint8Array(await response.arrayBuffer());
}

function complain(error) {
  const message = document.getElementById("message");
  message.hidden = false;
  message.firstElementChild.textContent = `This browser cannot show the scene: ${error && error.message || error}`;
  document.body.dataset.state = "failed";
}

async function start() {
  if (!window.DecompressionStream || !document.createElement("canvas").getContext("webgl2")) {
    throw new Error("it needs WebGL 2 and DecompressionStream, which browsers have had since 2023");
  }
  const imports = {};
  for (const script of document.querySelectorAll("script.module")) {
    const code = await unpacked(script.textContent).blob();
    imports[script.dataset.name] = URL.createObjectURL(new Blob([code], { type: "text/javascript" }));
    script.remove();
  }
  const map = document.createElement("script");
  map.type = "importmap";
  map.textContent = JSON.stringify({ imports });
  document.head.append(map);
  const { show } = await import(imports["drgs"]);
  await show(JSON.parse(document.getElementById("scene").textContent), bytesOfPart);
}

addEventListener("error", (event) => complain(event.error || event.message));
addEventListener("unhandledrejection", (event) => complain(event.reason));
start();
