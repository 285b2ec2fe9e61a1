
for (const slider of document.querySelectorAll(".slider")) {
  const frames = slider.querySelectorAll("figure");
  if (frames.length < 2) continue;
  const input = document.createElement("input");
  input.type = "range"; input.min = 0; input.max = frames.length - 1; input.value = frames.length - 1;
  input.setAttribute("aria-label", slider.getAttribute("aria-label"));
  const show = () => frames.forEach((f, i) => f.classList.toggle("now", i == input.value));
  input.addEventListener("input", show);
  slider.classList.add("live"); slider.prepend(input); show();
}
