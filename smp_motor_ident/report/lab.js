// The page of lab: draws what the server streams, and asks it for what the buttons say.
"use strict";
(() => {
  const {color, unpack, written, options} = smpCharts;
  const part = id => document.getElementById(id);
  const make = (tag, text = "", kind = "") => Object.assign(document.createElement(tag), {textContent: text, className: kind});
  const row = (...cells) => { const one = make("tr"); one.append(...cells.map(cell => cell instanceof Node ? cell : make("td", cell))); return one; };
  const label = wheel => { const text = wheel.replaceAll("_", " "); return text[0].toUpperCase() + text.slice(1); };
  const KEPT = 60, HEIGHT = {speed: 200, voltage: 160};
  let state = {wheels: [], columns: [], slot: 0.005, messages: [], supply: {}, diagnostics: [], recordings: [], motors: {}, identified: ""};
  let role = {drives: false, pages: 1};
  let designs = {}, pending = null, waiting = false, counter = 0;

  // The connection, which a worker keeps: drawing does not delay its beats, a page that hangs ends them
  function keepConnection(address, frozen) {
    let socket, heard = 0;
    const open = () => {
      socket = new WebSocket(address);
      socket.binaryType = "arraybuffer";
      socket.onmessage = ({data}) => postMessage(data, typeof data === "string" ? [] : [data]);
      socket.onclose = () => { postMessage(null); setTimeout(open, 1000); };
    };
    const send = text => { if (socket.readyState === WebSocket.OPEN) socket.send(text); };
    onmessage = ({data}) => { heard = performance.now(); if (data) send(data); };
    setInterval(() => { if (performance.now() - heard < frozen) send('{"do":"beat"}'); }, 80);
    open();
  }
  const code = `(${keepConnection})("ws://${location.host}${location.pathname}ws", 1000)`;
  const worker = new Worker(URL.createObjectURL(new Blob([code], {type: "text/javascript"})));
  const ask = (what, more = {}) => worker.postMessage(JSON.stringify({do: what, ...more}));
  worker.onmessage = ({data}) => {
    if (data === null) {
      showRole({drives: false, pages: 1});
      part("role").textContent = "not connected";
    } else if (typeof data === "string") {
      const [kind, content] = JSON.parse(data);
      ({state: show, role: showRole, designs: showDesigns, design: showDesign, step: showStep, refused: showRefusal})[kind](content);
    } else take(new Float32Array(data));
  };
  setInterval(() => worker.postMessage(""), 100);
  const halt = () => { if (role.drives && (state.armed || state.job)) ask("stop"); };
  document.addEventListener("visibilitychange", () => { if (document.hidden) halt(); });

  // Samples: one row for each slot of time, the columns of every wheel
  const times = [], values = [];  // values: one array for each wheel and column
  let paused = false, zoomed = null, dirty = false, drawn = 0, cost = 0, told = 0, pointed = null, frames = 0;

  function take(table) {
    const width = 1 + state.wheels.length * state.columns.length;
    if (width < 2) return;
    while (values.length < width - 1) values.push([]);
    if (table[0] * state.slot < times.at(-1)) { times.length = 0; values.forEach(one => { one.length = 0; }); }
    for (let at = 0; at < table.length; at += width) {
      times.push(table[at] * state.slot);
      for (let k = 1; k < width; k++) values[k - 1].push(Number.isFinite(table[at + k]) ? table[at + k] : null);
    }
    const old = times.findIndex(t => t > times.at(-1) - KEPT);
    if (old > 1000) { times.splice(0, old); values.forEach(one => one.splice(0, old)); }
    if (dirty) return;
    dirty = true;  // drawing takes at most a third of the time
    setTimeout(() => requestAnimationFrame(draw), Math.max(0, drawn + 3 * cost - performance.now()));
  }
  const column = (wheel, name) => values[state.wheels.indexOf(wheel) * state.columns.length + state.columns.indexOf(name)] || [];
  const before = (list, end) => { for (let k = end; k >= Math.max(0, end - 40); k--) if (list[k] != null) return list[k]; return null; };
  const from = time => { let low = 0, high = times.length; while (low < high) { const middle = (low + high) >> 1; if (times[middle] < time) low = middle + 1; else high = middle; } return low; };

  const SHOWN = {
    speed: [["setpoint", "ink"], ["reference", "muted"], ["speed", "measured"], ["prediction", "simulated"]],
    voltage: [["voltage", "voltage"], ["current", "simulated"]],
  };
  const plots = [];
  const nice = size => { const unit = 10 ** Math.floor(Math.log10(size)); return [1, 2, 5, 10].find(k => k * unit >= size) * unit; };

  function plot(place, wheel, kind) {
    const chart = {x_label: "time [s]", y_label: kind === "speed" ? "rad/s" : "V, A", lines: [], spans: [], log: "", group: "watch", height: HEIGHT[kind]};
    chart.curves = SHOWN[kind].map(([name, shade]) => ({name, color: shade, width: 1.5, kind: "line"}));
    const made = options(chart, place.clientWidth || 280);
    for (const one of made.series) one.spanGaps = true;
    if (kind === "speed") made.series[1].dash = [5, 3];
    made.legend = {show: false};
    made.scales.y = {range: u => [-u.most || -1, u.most || 1]};
    made.cursor = {...made.cursor, drag: {setScale: false}, bind: {dblclick: () => () => pause(false)}};
    made.hooks.setCursor = [() => { pointed = u.cursor.idx == null || u.cursor.left < 0 ? null : u.data[0][u.cursor.idx]; tell(); }];
    made.hooks.setSelect = [() => { if (u.select.width > 4) { zoomed = [u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x")]; pause(true); u.setSelect({left: 0, width: 0}, false); } }];
    const u = new uPlot(made, [[], ...chart.curves.map(() => [])], place);
    u.limits = chart.lines;
    u.wheel = wheel; u.kind = kind;
    plots.push(u);
    new ResizeObserver(() => { if (place.clientWidth && place.clientWidth !== u.width) u.setSize({width: place.clientWidth, height: HEIGHT[kind]}); }).observe(place);
  }
  for (const place of document.querySelectorAll(".wheel .plot")) plot(place, place.closest(".wheel").dataset.wheel, place.dataset.kind);

  const range = () => zoomed || [times.at(-1) - Number(part("window").value), times.at(-1)];
  function draw() {
    dirty = false;
    frames += 1;
    drawn = performance.now();
    if (drawn - told > 100) { told = drawn; tell(); settle(); }
    if (!paused) redraw();
    cost = performance.now() - drawn;
  }
  function tell() {
    for (const wheel of state.wheels) {
      const panel = part(`wheel-${wheel}`), now = name => before(column(wheel, name), pointed == null ? times.length - 1 : from(pointed)), text = (v, unit) => v == null ? "–" : `${(Math.round(100 * v) / 100 + 0).toFixed(2)} ${unit}`;
      const target = now("setpoint"), speed = now("speed");
      for (const [name, value, unit] of [["speed", speed, "rad/s"], ["setpoint", target, "rad/s"], ["error", target == null || speed == null ? null : target - speed, "rad/s"], ["voltage", now("voltage"), "V"], ["current", now("current"), "A"]])
        panel.querySelector(`.${name}`).textContent = text(value, unit);
    }
  }
  function redraw() {
    if (!times.length) return;
    const [begin, end] = range(), first = Math.max(0, from(begin) - 1), last = Math.min(times.length, from(end) + 1), x = times.slice(first, last);
    for (const u of plots) {
      const data = SHOWN[u.kind].map(([name]) => column(u.wheel, name).slice(first, last));
      const size = list => list.reduce((most, v) => v == null ? most : Math.max(most, Math.abs(v)), 0);
      const supply = u.kind === "voltage" && state.supply[u.wheel];
      u.most = supply ? 1.08 * supply : nice(1.05 * Math.max(0.5, ...data.map(size)));
      if (supply) u.limits.splice(0, 2, supply, -supply);
      u.batch(() => { u.setData([x, ...data], false); u.setScale("x", {min: begin, max: end}); });
    }
  }
  setInterval(() => { document.body.dataset.frames = frames; frames = 0; }, 1000);
  function pause(yes) { paused = yes; if (!yes) zoomed = null; part("pause").setAttribute("aria-pressed", yes); redraw(); }
  part("pause").addEventListener("click", () => pause(!paused));
  part("window").addEventListener("change", () => { if (!paused) redraw(); });
  part("save").addEventListener("click", () => {
    const [begin, end] = range(), names = state.wheels.flatMap(wheel => state.columns.map(name => `${wheel}_${name}`));
    const lines = [["time", ...names].join(",")];
    for (let k = from(begin); k < times.length && times[k] <= end; k++) lines.push([times[k].toFixed(4), ...values.map(one => one[k] ?? "")].join(","));
    const link = make("a");
    link.href = URL.createObjectURL(new Blob([lines.join("\n") + "\n"], {type: "text/csv"}));
    link.download = "lab.csv";
    link.click();
  });

  function show(content) {
    const old = state;
    state = content;
    part("arm").setAttribute("aria-pressed", state.armed);
    part("arm").textContent = state.armed ? "Armed" : "Arm";
    const doing = state.job ? `${state.job[0].toUpperCase()}${state.job.slice(1)}${state.progress ? `: ${state.progress}` : ""} …` : "";
    part("job").textContent = doing || (state.armed ? "Armed: the wheels may turn." : "Nothing moves before Arm. Put the robot on blocks first.");
    if (changed(old.messages, state.messages)) list("messages", state.messages.slice(-2).map(([, kind, text]) => [{error: "refused", stop: "warning"}[kind] || "", text]));
    list("diagnostics", state.diagnostics.map(([name, level, text]) => ["", `${name}: ${["", "warning: ", "error: ", "stale: "][level]}${text}`]));
    for (const wheel of state.wheels) {
      const [, level, text] = state.diagnostics.find(([name]) => name.endsWith(`${wheel}/wheel_pid`)) || ["", 0, "no wheel_pid"];
      Object.assign(part(`wheel-${wheel}`).querySelector(".health"), {textContent: text, className: `small health ${["", "warn", "bad", "bad"][level]}`});
    }
    if (changed(old.signals, state.signals)) { part("signal").replaceChildren(...state.signals.map(name => make("option", name))); part("signal").value = "fourier"; }
    part("recordings").textContent = state.recordings.length ? `Recorded: ${state.recordings.join(", ")}.` : "No recording.";
    if (changed(old.motors, state.motors)) showMotors(state.motors);
    if (old.identified !== state.identified) part("report").src = state.identified ? `results/${state.identified}/report.html` : "about:blank";
    const made = state.designed;
    part("designed").textContent = made ? `${made.name}: ${made.reason}.` : "No design.";
    part("gains").hidden = !made;
    if (made) { part("gains").href = `results/${made.name}`; part("gains").download = made.name; }
    part("trial").textContent = state.trial ? `On trial: ${state.trial.wheels.map(label).join(", ")}. Keep the gains, or take them back.` : "";
    part("cannot").textContent = state.drives ? "Drag, or hold the arrow keys; the wheels stop on release." : "No node takes cmd_vel: start skid_steer to drive.";
    enable();
  }
  const changed = (before, now) => JSON.stringify(before) !== JSON.stringify(now);
  const list = (id, lines) => part(id).replaceChildren(...lines.map(([kind, text]) => make("li", text, kind)));
  function showMotors(motors) {
    const names = new Set(Object.values(motors).flatMap(one => Object.keys(one.values)));
    const cells = what => state.wheels.map(wheel => { const [text, note] = (motors[wheel] && what(motors[wheel])) || ["–"], one = make("td", text); if (note) one.append(make("small", note)); return one; });
    part("motors").tBodies[0].replaceChildren(row("State", ...cells(one => [one.state, one.fit == null ? "" : `fit ${one.fit.toFixed(1)} %`])), ...[...names].map(name => row(name, ...cells(one => one.values[name]))));
    list("findings", Object.entries(motors).flatMap(([wheel, one]) => one.findings.map(([severity, text]) => [severity, `${label(wheel)}: ${text}`])));
  }
  function showRole(content) {
    role = content;
    part("role").textContent = role.drives ? (role.pages > 1 ? `drives; ${role.pages - 1} watching` : "drives") : "watches";
    part("take").hidden = role.drives;
    document.body.classList.toggle("watching", !role.drives);
    enable();
  }
  function enable() {
    const may = {excite: state.armed, apply: state.armed && designs[part("wheel").value]?.parameters, step: state.armed && designs[part("wheel").value], identify: state.recordings.length, discard: state.recordings.length, tune: state.identified, keep: state.trial, back: state.trial, arm: !state.armed};
    for (const [id, possible] of Object.entries(may)) part(id).disabled = !role.drives || Boolean(state.job) || !possible;
    for (const one of document.querySelectorAll("fieldset")) one.disabled = !role.drives;
    for (const id of ["share", "phase_margin", "p", "i", "d"]) part(id).disabled = !role.drives || !Object.keys(designs).length;
  }
  function showRefusal(text) { list("messages", [["refused", text]]); waiting = false; pending = null; }

  for (const what of ["arm", "stop", "take", "discard", "identify", "keep", "back"]) part(what).addEventListener("click", () => ask(what));
  part("excite").addEventListener("click", () => ask("excite", {wheels: [...document.querySelectorAll(".excited:checked")].map(one => one.value), signal: part("signal").value, amplitude: part("amplitude").valueAsNumber, seconds: part("seconds").valueAsNumber}));
  part("tune").addEventListener("click", () => ask("tune", {accept: part("accept").checked}));
  for (const what of ["apply", "step"]) part(what).addEventListener("click", () => ask(what, {wheel: part("wheel").value}));

  const figures = {};
  let measured = {};
  function showDesigns(content) {
    designs = content.designs;
    measured = {};
    Object.values(figures).forEach(u => u.destroy());
    part("tune-charts").replaceChildren();
    for (const chart of content.charts) {
      chart.curves[0].name = "designed";
      if (chart.name === "tuning-step") chart.curves.push({name: "measured", color: "simulated", kind: "line", width: 1.5, low: null, high: null, y: null});
      const figure = make("figure", "", "chart"), place = make("div", "", "live");
      Object.assign(place, {role: "img", ariaLabel: chart.title});
      figure.append(make("h3", chart.title), place);
      part("tune-charts").append(figure);
      figures[chart.name] = new uPlot(options(chart, place.clientWidth || 480), [[0, 1]], place);
      new ResizeObserver(() => { if (place.clientWidth) figures[chart.name].setSize({width: place.clientWidth, height: chart.height}); }).observe(place);
    }
    [part("share").value, part("phase_margin").value] = [1, 60];
    showDesign({...designs[part("wheel").value], ms: null});
  }
  function showDesign(made) {
    waiting = false;
    if (made.asked != null) { designs[made.wheel] = made; measured[made.wheel] = null; }
    if (pending) { const next = pending; pending = null; request(next); }
    if (made.wheel !== part("wheel").value) return;
    part("reason").textContent = made.reason || "";
    part("rows").replaceChildren(...(made.rows || []).map(([name, value, band]) => row(make("td", name), make("td", value, "num strong"), make("td", band, "num"))));
    part("yaml").textContent = made.yaml || "";
    part("yaml").dataset.ms = made.ms ?? "";
    if (made.gains) for (const [k, name] of ["p", "i", "d"].entries()) if (document.activeElement !== part(name)) part(name).value = Number(made.gains[k].toPrecision(4));
    part("share-shown").textContent = made.crossover ? `${written(made.crossover)} rad/s` : "";
    part("margin-shown").textContent = made.phase_margin ? `${made.phase_margin.toFixed(0)}°` : "";
    for (const [name, arrays] of Object.entries(made.charts || {})) {
      const data = arrays.map(unpack);
      if (name === "tuning-step") data.push(measured[made.wheel] || data[0].map(() => null));
      figures[name].setData(data);
    }
    enable();
  }
  function showStep(step) { measured[step.wheel] = unpack(step.speed); showDesign({...designs[step.wheel], asked: null}); }
  function request(values) {
    if (waiting) { pending = values; return; }
    waiting = true;
    ask("design", {asked: ++counter, ...values});
  }
  for (const id of ["share", "phase_margin"]) part(id).addEventListener("input", () => request({wheel: part("wheel").value, share: Number(part("share").value), phase_margin: Number(part("phase_margin").value)}));
  for (const id of ["p", "i", "d"]) part(id).addEventListener("input", () => request({wheel: part("wheel").value, ...Object.fromEntries(["p", "i", "d"].map(name => [name, part(name).valueAsNumber]))}));
  part("wheel").addEventListener("change", () => { if (designs[part("wheel").value]) showDesign({...designs[part("wheel").value], asked: null}); });

  const pad = part("pad"), held = new Set();
  let stick = [0, 0], wasDriving = false;  // right and ahead, -1 to 1
  function move(right, ahead) {
    const size = Math.max(1, Math.hypot(right, ahead));
    stick = [right / size, ahead / size];
    part("knob").style.transform = `translate(${92 * stick[0]}px, ${-92 * stick[1]}px)`;
  }
  const point = event => { const box = pad.getBoundingClientRect(); move((event.clientX - box.left - box.width / 2) / 92, -(event.clientY - box.top - box.height / 2) / 92); };
  pad.addEventListener("pointerdown", event => { pad.setPointerCapture(event.pointerId); pad.focus(); point(event); event.preventDefault(); });
  pad.addEventListener("pointermove", event => { if (pad.hasPointerCapture(event.pointerId)) point(event); });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) pad.addEventListener(end, () => move(0, 0));
  const KEYS = {ArrowUp: [0, 1], ArrowDown: [0, -1], ArrowLeft: [-1, 0], ArrowRight: [1, 0], w: [0, 1], s: [0, -1], a: [-1, 0], d: [1, 0]};
  const follow = () => move(...[...held].map(key => KEYS[key]).reduce(([x, y], [a, b]) => [x + a, y + b], [0, 0]));
  addEventListener("keydown", event => {
    if (event.key === " " && (state.armed || state.job)) { ask("stop"); event.preventDefault(); event.stopPropagation(); return; }
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (!KEYS[key] || document.activeElement !== pad) return;
    held.add(key); follow(); event.preventDefault();
  }, true);
  addEventListener("keyup", event => { if (held.delete(event.key.length === 1 ? event.key.toLowerCase() : event.key)) follow(); });
  for (const source of [pad, window]) source.addEventListener("blur", () => { held.clear(); move(0, 0); });
  addEventListener("blur", () => { if (document.activeElement === part("report")) halt(); });  // it hears no space bar
  setInterval(() => {
    for (const [id, unit] of [["linear", "m/s"], ["angular", "rad/s"]]) part(`${id}-shown`).textContent = `${Number(part(id).value).toFixed(2)} ${unit}`;
    const driving = role.drives && state.armed && (stick[0] !== 0 || stick[1] !== 0);
    const linear = driving ? stick[1] * Number(part("linear").value) : 0, angular = driving ? -stick[0] * Number(part("angular").value) : 0;
    if (driving || wasDriving) ask("drive", {linear, angular});
    wasDriving = driving;
    part("commanded").textContent = `${linear.toFixed(2)} m/s, ${angular.toFixed(2)} rad/s`;
  }, 50);

  // From a change of a wheel's set-point until its speed, over five samples, stays within 5 % of the change.
  const changes = {}, REST = 0.6, LEAST = 0.3, SMOOTH = 5;
  function settle() {
    const end = times.at(-1);
    for (const wheel of state.wheels) {
      const asked = column(wheel, "setpoint"), target = before(asked, times.length - 1) ?? 0, one = changes[wheel] ||= {target, old: target, moved: 0};
      if (Math.abs(target - one.target) > 1e-3) {  // it may be a ramp
        if (end - one.moved > REST) one.old = one.target;
        Object.assign(one, {target, moved: end, settled: null});
      } else if (one.settled === null && end - one.moved > REST && Math.abs(target - one.old) > LEAST) {
        let begin = from(one.moved), out = 0;
        const moved = value => value != null && Math.abs(value - one.old) > 1e-6;
        while (begin > 0 && moved(before(asked, begin - 1))) begin--;
        const speed = column(wheel, "speed").slice(begin).filter(v => v != null), step = (end - times[begin]) / speed.length;
        for (let k = SMOOTH; k <= speed.length; k++) if (Math.abs(speed.slice(k - SMOOTH, k).reduce((a, b) => a + b) / SMOOTH - target) > 0.05 * Math.abs(target - one.old)) out = k;
        one.settled = 1000 * step * out;
      }
    }
    const all = state.wheels.map(wheel => changes[wheel].settled);
    if (all.some(ms => ms == null)) return;
    part("settled").replaceChildren(...state.wheels.map((wheel, k) => row(label(wheel), `${all[k].toFixed(0)} ms`)), row("Spread", `${(Math.max(...all) - Math.min(...all)).toFixed(0)} ms`));
  }

  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => [...plots, ...Object.values(figures)].forEach(u => u.redraw(false, true)));
})();
