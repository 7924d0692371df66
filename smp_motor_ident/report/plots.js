// Draws the charts of the page with uPlot: drag or +/- zooms, the legend reads values, Escape resets.
"use strict";
(() => {
  const charts = JSON.parse(document.getElementById("charts").textContent);
  const color = name => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  const plots = [];
  let update = () => {};  // shows the chosen design in the charts of the tuning page

  const unpack = text => {
    const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
    return Array.from(new Float32Array(bytes.buffer), v => Number.isNaN(v) ? null : v);
  };
  const written = value => value == null ? "–" : Number(value.toPrecision(5)).toString();

  const marks = chart => ({
    drawClear: u => {
      const {left, top, width, height} = u.bbox;
      u.ctx.save();
      u.ctx.beginPath(); u.ctx.rect(left, top, width, height); u.ctx.clip();
      for (const [begin, end, name] of chart.spans) {
        u.ctx.fillStyle = color(name);
        const x = u.valToPos(begin, "x", true);
        u.ctx.fillRect(x, top, u.valToPos(end, "x", true) - x, height);
      }
      u.ctx.restore();
    },
    draw: u => {
      const {left, top, width, height} = u.bbox;
      u.ctx.save();
      u.ctx.strokeStyle = color("muted");
      u.ctx.setLineDash([4, 3]);
      for (const level of chart.lines) {
        const y = u.valToPos(level, "y", true);
        if (y < top || y > top + height) continue;
        u.ctx.beginPath(); u.ctx.moveTo(left, y); u.ctx.lineTo(left + width, y); u.ctx.stroke();
      }
      u.ctx.restore();
    },
  });

  function options(chart, width) {
    const series = [{label: chart.x_label, value: (u, v) => written(v)}];
    const bands = [];
    for (const curve of chart.curves) {
      const stroke = () => color(curve.color) + (curve.width > 2 ? "88" : "");  // a wide one lies behind another
      const one = {label: curve.name, stroke, width: curve.width, points: {show: false}, value: (u, v) => written(v)};
      if (curve.kind === "points") Object.assign(one, {width: 0, paths: () => null, points: {show: true, size: 5, stroke, fill: stroke}});
      if (curve.kind === "bars") Object.assign(one, {paths: uPlot.paths.bars({size: [0.4, 6]}), fill: stroke});
      series.push(one);
      if (curve.low) {
        const hidden = {class: "edge", stroke: "transparent", points: {show: false}};
        series.push({...hidden}, {...hidden});
        bands.push({series: [series.length - 1, series.length - 2], fill: () => color(curve.color) + "30"});
      }
    }
    const axis = {stroke: () => color("muted"), grid: {stroke: () => color("grid"), width: 1}, ticks: {show: false}, values: (u, marks) => marks.map(v => v == null ? "" : written(v))};
    const scale = name => chart.log.includes(name) ? {distr: 3} : {};
    const y = scale("y");
    if (chart.lines.length && !y.distr) {
      y.range = (u, low, high) => {
        const ends = [low, high, ...chart.lines].filter(v => v != null);
        const a = Math.min(...ends), b = Math.max(...ends), wide = 0.08 * (b - a || 1);
        return [a - wide, b + wide];
      };
    }
    return {
      width, height: chart.height, series, bands,
      scales: {x: {time: false, ...scale("x")}, y},
      axes: [{...axis, label: chart.x_label, labelSize: 20, size: 30}, {...axis, label: chart.y_label, labelSize: 20, size: 54, space: 18}],
      cursor: chart.group ? {sync: {key: chart.group, setSeries: false}} : {},
      hooks: {drawClear: [marks(chart).drawClear], draw: [marks(chart).draw]},
    };
  }

  function zoom(u, factor) {
    const {min, max} = u.scales.x;
    const log = u.scales.x.distr === 3, to = log ? Math.log : v => v, back = log ? Math.exp : v => v;
    const at = u.cursor.left >= 0 ? to(u.posToVal(u.cursor.left, "x")) : (to(min) + to(max)) / 2;
    u.setScale("x", {min: back(at - (at - to(min)) * factor), max: back(at + (to(max) - at) * factor)});
  }
  const reset = u => u.setScale("x", {min: u.data[0][0], max: u.data[0][u.data[0].length - 1]});

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
    part("copy").addEventListener("click", async () => {
      try {
        await navigator.clipboard.writeText(part("yaml").textContent);
        part("copied").textContent = "copied";
      } catch {
        getSelection().selectAllChildren(part("yaml"));
        part("copied").textContent = "marked: press Ctrl-C";
      }
    });
    update = show;
    choose();
  }

  addEventListener("beforeprint", () => document.querySelectorAll("details").forEach(one => { one.open = true; }));
  const redraw = () => plots.forEach(plot => plot.u.redraw(false, true));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  new ResizeObserver(() => plots.forEach(plot => {
    const width = plot.place.clientWidth;
    if (width && width !== plot.u.width) plot.u.setSize({width, height: plot.u.height});
  })).observe(document.querySelector("main"));
})();
