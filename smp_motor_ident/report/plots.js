// Draws the charts of the page with uPlot: drag or +/- zooms, the legend reads values, Escape resets.
"use strict";
(() => {
  const {unpack, options, zoom, reset} = smpCharts;
  const charts = JSON.parse(document.getElementById("charts").textContent);
  const plots = [];
  let update = () => {};  // shows the chosen design in the charts of the tuning page

  // The charts of a group are zoomed together.
  const together = (plot, action) => {
    for (const other of plots) if (other === plot || (plot.group && other.group === plot.group)) action(other.u);
  };

  function draw(chart) {
    const figure = document.getElementById(`figure-${chart.name}`);
    const place = figure.querySelector(".live");
    const fold = figure.closest("details:not([open])");
    if (fold) {  // drawn when it is opened
      fold.addEventListener("toggle", () => { draw(chart); update(); }, {once: true});
      return;
    }
    place.hidden = false;
    const data = [unpack(chart.x)];
    for (const curve of chart.curves) {
      data.push(unpack(curve.y));
      if (curve.low) data.push(unpack(curve.low), unpack(curve.high));
    }
    const plot = {name: chart.name, group: chart.group, figure, place};
    plot.u = new uPlot(options(chart, place.clientWidth), data, place);
    const shown = plots.find(other => plot.group && other.group === plot.group);
    plots.push(plot);
    let passing = false;
    plot.u.hooks.setScale = [(u, key) => {
      if (key === "x") place.dataset.shown = `${u.scales.x.min} ${u.scales.x.max}`;
      if (key !== "x" || passing) return;
      passing = true;
      const {min, max} = u.scales.x;
      together(plot, other => { if (other !== u && (other.scales.x.min !== min || other.scales.x.max !== max)) other.setScale("x", {min, max}); });
      passing = false;
    }];
    const keys = {"+": () => zoom(plot.u, 0.5), "-": () => zoom(plot.u, 2), "0": () => reset(plot.u), Escape: () => reset(plot.u)};
    const move = by => plot.u.setCursor({left: Math.max(0, Math.min(plot.u.over.clientWidth, (plot.u.cursor.left < 0 ? 0 : plot.u.cursor.left) + by)), top: 5});
    place.addEventListener("keydown", event => {
      const by = {ArrowLeft: -5, ArrowRight: 5}[event.key];
      if (by) move(event.shiftKey ? 8 * by : by); else if (keys[event.key]) keys[event.key](); else return;
      event.preventDefault();
    });
    for (const button of figure.querySelectorAll("button")) button.addEventListener("click", keys[button.dataset.key]);
    figure.classList.add("ready");
    if (shown) plot.u.setScale("x", {min: shown.u.scales.x.min, max: shown.u.scales.x.max});
    else if (chart.view) plot.u.setScale("x", {min: chart.view[0], max: chart.view[1]});
  }
  charts.forEach(draw);

  // The tuning page: the sliders choose among designs that were computed beforehand.
  const tuning = JSON.parse(document.getElementById("tuning-data").textContent);
  const part = name => document.getElementById(`tuning-${name}`);
  if (part("wheel")) {
    const show = () => {
      const {choices} = tuning.wheels[part("wheel").value];
      const at = Number(part("margin").value) * tuning.shares.length + Number(part("bandwidth").value);
      const one = choices[at];
      part("reason").textContent = one ? one.reason || "" : tuning.wheels[part("wheel").value].reason;
      const cell = (text, kind) => Object.assign(document.createElement("td"), {textContent: text, className: kind});
      part("bandwidth-shown").textContent = one ? `${one.bandwidth} rad/s` : "";
      part("margin-shown").textContent = one ? `${one.margin}°` : "";
      part("bandwidth").setAttribute("aria-valuetext", part("bandwidth-shown").textContent);
      part("margin").setAttribute("aria-valuetext", part("margin-shown").textContent);
      part("rows").replaceChildren(...(one && one.rows || []).map(([name, value, band]) => {
        const row = document.createElement("tr");
        row.append(cell(name, ""), cell(value, "num strong"), cell(band, "num"));
        return row;
      }));
      part("yaml").textContent = one && one.yaml || "";
      part("copy").disabled = !part("yaml").textContent;
      part("copied").textContent = "";
      for (const plot of plots) if (one && one.charts && one.charts[plot.name]) plot.u.setData(one.charts[plot.name].map(unpack));
    };
    const choose = () => {
      const {chosen} = tuning.wheels[part("wheel").value];
      part("bandwidth").value = Math.max(chosen, 0) % tuning.shares.length;
      part("margin").value = Math.floor(Math.max(chosen, 0) / tuning.shares.length);
      show();
    };
    for (const name of ["bandwidth", "margin"]) part(name).addEventListener("input", show);
    part("wheel").addEventListener("change", choose);
    update = show;
    choose();
  }

  // A button copies the text of the element that it names; the element behind the button says so.
  for (const button of document.querySelectorAll("button[data-copy]")) button.addEventListener("click", async () => {
    const text = document.querySelector(button.dataset.copy), status = button.nextElementSibling;
    try {
      await navigator.clipboard.writeText(text.textContent);
      status.textContent = "copied";
    } catch {
      getSelection().selectAllChildren(text);
      status.textContent = "selected: press Ctrl-C";
    }
  });

  addEventListener("beforeprint", () => document.querySelectorAll("details").forEach(one => { one.open = true; }));
  const redraw = () => plots.forEach(plot => plot.u.redraw(false, true));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  new ResizeObserver(() => plots.forEach(plot => {
    const width = plot.place.clientWidth;
    if (width && width !== plot.u.width) plot.u.setSize({width, height: plot.u.height});
  })).observe(document.querySelector("main"));
})();
