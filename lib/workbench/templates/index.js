// Shows only those rows of the table of all numbers that contain every typed word.
const rows = [...document.querySelectorAll("#all tbody tr")].map((row) => [row, row.textContent.replaceAll("\u00ad", "").toLowerCase()]);
document.getElementById("find").addEventListener("input", (event) => {
  const words = event.target.value.toLowerCase().split(/\s+/).filter(Boolean);
  let shown = 0;
  for (const [row, text] of rows) {
    row.hidden = !words.every((word) => text.includes(word));
    shown += !row.hidden;
  }
  document.getElementById("found").textContent = words.length ? `${shown} of ${rows.length}` : "";
});
