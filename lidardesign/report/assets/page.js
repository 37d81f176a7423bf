"use strict";
// What the page does beside the 3D view: draws its curves, answers their switches, and makes itself ready for paper.

const QUIET = { responsive: true, displaylogo: false, plotlyServerURL: "", showTips: false };
const LEGEND_PX = 60; // of a picture's height
const [PAPER_PX, HALF_PX] = [680, 330]; // what fits on the width of a sheet, once and beside another

// Every curve is a line and its band, and is switched in all figures of curves.
function answerCurves() {
  for (const input of all("[data-curve]")) {
    input.addEventListener("input", () => {
      const traces = [2 * Number(input.dataset.curve), 2 * Number(input.dataset.curve) + 1];
      for (const figure of all(".curves")) Plotly.restyle(figure, { visible: input.checked }, traces);
    });
  }
}

// The mode bar's button. Legends are in the page, where the keyboard reaches them; a picture gets its own.
function svgButton(name) {
  const click = ({ data, layout, clientWidth: width, clientHeight }) => {
    const named = data.some((trace) => trace.name);
    const legend = { showlegend: named, legend: { orientation: "h", y: -0.25 }, width: null, height: null };
    const size = { width, height: clientHeight + (named ? LEGEND_PX : 0) };
    return Plotly.downloadImage({ data, layout: { ...layout, ...legend } }, { format: "svg", filename: name, ...size });
  };
  return { name: "svg", title: "Download as SVG", icon: Plotly.Icons.camera, click };
}

const figures = () => all(".js-plotly-plot");
let opened = [];

// The 3D view becomes a picture, curves get the sheet's width, and all that folds is opened.
function toPaper() {
  opened = all("details:not([open])");
  for (const fold of opened) fold.open = true;
  if (view) find("#view-printed").src = scenePicture();
  for (const figure of figures()) Plotly.relayout(figure, { width: figure.closest(".tiles") ? HALF_PX : PAPER_PX, autosize: false });
}

function toScreen() {
  for (const fold of opened) fold.open = false;
  opened = [];
  for (const figure of figures()) Plotly.relayout(figure, { width: null, autosize: true });
}

// On narrow screens a row is a card, whose cells are named by their columns.
function nameCells() {
  for (const grid of all("table")) {
    const names = [...grid.tHead.rows[0].cells].map((cell) => cell.textContent);
    for (const row of grid.tBodies[0].rows) [...row.cells].forEach((cell, column) => (cell.dataset.name = names[column]));
  }
}

async function drawFigures() {
  nameCells();
  // plotly is large: it is read once the 3D view stands
  document.head.append(Object.assign(document.createElement("script"), { textContent: find("#plotly").textContent }));
  for (const data of all("script[data-figure]")) {
    const { data: traces, layout } = JSON.parse(data.textContent);
    const name = data.dataset.figure;
    await Plotly.newPlot(name, traces, layout, { ...QUIET, modeBarButtons: [[svgButton(name)]] });
  }
  answerCurves();
  window.addEventListener("beforeprint", toPaper);
  window.addEventListener("afterprint", toScreen);
  document.documentElement.dataset.drawn = "yes";
  performance.mark("drawn");
}

requestAnimationFrame(() => setTimeout(drawFigures));
