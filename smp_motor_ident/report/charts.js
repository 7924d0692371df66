// Charts by uPlot, for the pages of reports and for the page of lab.
"use strict";
const smpCharts = (() => {
  const color = name => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
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

  return {color, unpack, written, options, zoom, reset};
})();
