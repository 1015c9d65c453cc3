// The interactive parts of a page: 3D views, pictures with controls, and the table of contents on a small screen.
for (const view of document.querySelectorAll(".plotly-view")) {
  const figure = JSON.parse(view.nextElementSibling.textContent);
  const eye = figure.layout.scene?.camera?.eye ?? {};  // the height sets the scale, so a narrow view needs more distance
  if (view.clientWidth < 620) Object.keys(eye).forEach((axis) => { eye[axis] *= 1.6; });
  Plotly.newPlot(view, figure.data, figure.layout, { responsive: true, displaylogo: false });
}
for (const box of document.querySelectorAll(".explore")) {
  const knobs = [...box.querySelectorAll("input")];
  for (const knob of knobs) {
    knob.disabled = false;
    knob.addEventListener("input", () => {
      for (const other of knobs) {
        if (other !== knob) other.value = other.defaultValue;
        other.nextElementSibling.textContent = other.dataset.texts.split("|")[other.value];
      }
      const name = knob.value === knob.defaultValue ? "default" : `${knob.name}-${knob.value}`;
      for (const picture of box.querySelectorAll("img")) picture.hidden = picture.dataset.at !== name;
    });
  }
}
if (window.matchMedia("(max-width: 1100px)").matches) document.querySelector("aside details")?.removeAttribute("open");
