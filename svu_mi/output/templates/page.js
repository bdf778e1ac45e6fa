// Frames of a turntable, one at a time under a slider.
for (const table of document.querySelectorAll(".turntable")) {
  const frames = table.querySelectorAll(".frames > *");
  const slider = table.querySelector(".control input");
  const show = () => frames.forEach((frame, k) => frame.classList.toggle("shown", k == slider.value));
  slider.addEventListener("input", show);
  table.classList.add("turning");
  show();
}
