"use strict";
// Optuna's figures, drawn by Plotly on white paper, also in dark mode: their colours are made for it.
for (const place of document.querySelectorAll(".plot")) {
  const figure = JSON.parse(place.querySelector("script").textContent);
  place.replaceChildren();
  const layout = { ...figure.layout, autosize: true, margin: { l: 60, r: 20, t: 20, b: 60 }, paper_bgcolor: "#fff", plot_bgcolor: "#fff" };
  // Room for the names of parameters.
  for (const key of Object.keys(layout)) if (/^[xy]axis/.test(key)) layout[key] = { ...layout[key], automargin: true };
  Plotly.newPlot(place, figure.data, layout, { responsive: true, displaylogo: false });
}
