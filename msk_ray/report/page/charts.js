"use strict";
// Draws the charts that the page describes (report/charts.py) with Apache ECharts. `page.draw()` draws all of them.
const page = (() => {
  let trials = []; // [experiment, id, variant, seed, outcome, score], by position
  let charts = {}; // name → description
  let shown = null; // positions of the trials to show; null: all
  const hidden = {}; // name → names of styles switched off
  const whole = new Set(); // charts whose axes show curves that leave them
  const drawn = new Map(); // element → {chart, series}
  const GRID = { left: 12, right: 18, top: 26, bottom: 30, containLabel: true };
  const CROSS = "path://M0,0L2,0L6,4L10,0L12,0L12,2L8,6L12,10L12,12L10,12L6,8L2,12L0,12L0,10L4,6L0,2Z";
  const SYMBOLS = { o: { symbol: "circle", symbolSize: 7 }, x: { symbol: CROSS, symbolSize: 9 }, _: { symbol: "rect", symbolSize: [26, 3] } };
  const DASHES = { "-": "solid", "--": "dashed", "-.": [8, 3, 2, 3], ":": "dotted" };

  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const tone = (colour) => (typeof colour === "string" ? colour : colour[+css("--dark")]);
  const visible = (mark) => mark.trial === null || shown === null || shown.has(mark.trial);
  const label = (trial) => {
    const [experiment, id, variant, seed, outcome] = trials[trial];
    const several = new Set(trials.map((t) => t[0])).size > 1;
    return `${several ? `${experiment}: ` : ""}${id}\n${variant}, seed ${seed}, ${outcome}`;
  };
  const words = (mark, more = "") => [mark.trial === null ? "" : label(mark.trial), mark.text, more].filter(Boolean).join("\n");
  const count = (v) => {
    const size = Math.abs(v);
    const [unit, name] = size >= 1e9 ? [1e9, "G"] : size >= 1e6 ? [1e6, "M"] : size >= 1e3 ? [1e3, "k"] : [1, ""];
    return `${+(v / unit).toPrecision(4)}${name}`;
  };
  const number = (v) => (Math.abs(v) >= 1e5 || (v !== 0 && Math.abs(v) < 1e-3) ? v.toExponential(2).replace(/\.?0+e/, "e") : String(+v.toPrecision(5)));
  const format = (axis) => (axis.scale === "count" ? count : number);
  // Text, never markup: names come from people.
  const bubble = (text) => {
    const box = document.createElement("div");
    box.textContent = text;
    box.style.cssText = "white-space: pre-wrap; max-width: 20rem; overflow-wrap: anywhere";
    return box;
  };

  // ---- ECharts' options of a panel: {option, height, brush}

  const base = (more) => ({
    animation: false, backgroundColor: "transparent", textStyle: { fontFamily: "inherit", color: css("--ink") },
    tooltip: {
      trigger: "item", confine: true, backgroundColor: css("--paper"), borderColor: css("--line"),
      textStyle: { color: css("--ink"), fontSize: 13 }, formatter: (p) => bubble(words(p.data.mark)),
    }, ...more,
  });
  function scale(axis, more = {}) {
    const levels = axis.labels.length && {
      interval: 1, splitLine: { show: false }, axisTick: { show: false },
      axisLabel: { color: css("--ink"), formatter: (v) => axis.labels[v] ?? "", customValues: axis.labels.map((_, i) => i), rotate: axis.labels.length > 4 ? 35 : 0, width: 90, overflow: "truncate" },
    };
    return {
      type: axis.scale === "log" ? "log" : "value", scale: true, name: axis.name, nameLocation: "middle", nameGap: 28, nameTextStyle: { color: css("--dim") },
      min: axis.low ?? undefined, max: axis.high ?? undefined, axisLabel: { color: css("--ink"), formatter: format(axis), hideOverlap: true },
      axisLine: { show: true, onZero: false, lineStyle: { color: css("--dim") } }, splitLine: { lineStyle: { color: css("--grid") } }, ...levels, ...more,
    };
  }
  // Zooming by the wheel only with Ctrl: without it, the wheel scrolls the page. A finger scrolls it too.
  const zoom = () => [0, 1].map((way) => ({
    type: "inside", [way ? "yAxisIndex" : "xAxisIndex"]: 0, filterMode: "none", zoomOnMouseWheel: "ctrl",
    moveOnMouseMove: matchMedia("(pointer: fine)").matches, moveOnMouseWheel: false, preventDefaultMouseMove: false,
  }));

  function plot(panel, look, name, alone) {
    const series = [];
    const pairs = (x, y) => x.map((at, i) => [at, y[i]]);
    for (const mark of panel.lines) {
      if (!look[mark.style] || !visible(mark) || mark.when === (shown === null ? "filtered" : "unfiltered")) continue;
      const { color, width, type, opacity } = look[mark.style];
      if (mark.low) {
        const edge = { type: "line", stack: `band ${series.length}`, stackStrategy: "all", symbol: "none", silent: true, lineStyle: { opacity: 0 } };
        series.push({ ...edge, data: pairs(mark.x, mark.low) });
        series.push({ ...edge, data: pairs(mark.x, mark.high.map((v, i) => v - mark.low[i])), areaStyle: { color, opacity: 0.16 } });
      }
      // The pointer looks for the nearest line itself: a symbol for each point would make large charts slow.
      series.push({
        type: "line", symbol: "circle", symbolSize: 5, showSymbol: mark.x.length === 1, silent: true, data: pairs(mark.x, mark.y),
        lineStyle: { color, width, type, opacity }, itemStyle: { color }, emphasis: { focus: "series", lineStyle: { width: width + 1.5 } },
        trial: mark.trial ?? undefined, says: words(mark) && ((x, y) => words(mark, `${number(y)} at ${format(panel.x)(x)} ${panel.x.name}`)),
      });
    }
    look.forEach((style, i) => {
      const marks = style ? panel.points.filter((mark) => mark.style === i && visible(mark)) : [];
      const open = { color: "transparent", borderColor: style?.color, borderWidth: 1.5 };
      if (marks.length) series.push({ type: "scatter", ...SYMBOLS[style.marker], itemStyle: { color: style.color, opacity: style.opacity }, data: marks.map((mark) => ({ value: [mark.x, mark.y], mark, itemStyle: mark.hollow ? open : undefined })) });
    });
    const floor = panel.y.floor && !whole.has(name) ? { min: panel.y.floor.at } : {};
    return {
      height: alone ? 400 : panel.x.labels.length ? 260 : 230, half: !alone,
      option: base({ grid: { ...GRID, left: panel.y.name ? 44 : 12 }, xAxis: scale(panel.x), yAxis: scale(panel.y, { nameGap: 56, ...floor }), series }),
    };
  }

  function bars(panel, look) {
    const rows = panel.rows.filter((row) => look[row.style] && visible(row));
    const series = [{
      type: "bar", barMaxWidth: 18, label: { show: true, position: "right", color: css("--ink"), formatter: (p) => rows[p.dataIndex].note },
      data: rows.map((row) => ({ value: row.value, mark: row, itemStyle: { color: look[row.style].color } })),
      markLine: { silent: true, symbol: "none", label: { formatter: panel.rule_name, position: "start", color: css("--dim") }, lineStyle: { color: css("--ink"), type: "dotted" }, data: panel.rules.map((at, i) => ({ xAxis: at, label: { show: i === 0 } })) },
    }];
    // A trial is called by its id: the bubble says the rest.
    const names = rows.map((row) => (row.trial === null ? row.label : trials[row.trial][1]));
    const axisLabel = { color: css("--ink"), width: 110, overflow: "truncate" };
    const noted = rows.some((row) => row.note);
    return {
      height: 100 + Math.min(620, Math.max(60, (noted ? 26 : 18) * rows.length)),
      option: base({ grid: { ...GRID, right: noted ? 70 : 18 }, xAxis: scale(panel.x, { min: 0 }), yAxis: { type: "category", inverse: true, data: names, axisLabel, axisTick: { show: false }, axisLine: { lineStyle: { color: css("--dim") } } }, series }),
    };
  }

  function parallel(panel, wide) {
    const marks = panel.lines.filter(visible);
    const ink = { color: css("--ink") };
    const axes = panel.axes.map((axis, dim) => ({
      dim, name: axis.name, type: axis.labels.length ? "category" : axis.scale === "log" ? "log" : "value", scale: true, min: axis.low ?? undefined, max: axis.high ?? undefined,
      ...(axis.labels.length ? { data: axis.labels } : { axisLabel: { ...ink, formatter: number, hideOverlap: true } }),
    }));
    return {
      height: wide ? 380 : 90 + 110 * axes.length, brush: true,
      option: base({
        parallel: {
          layout: wide ? "horizontal" : "vertical", left: wide ? 40 : 24, right: wide ? 70 : 30, top: wide ? 40 : 16, bottom: wide ? 24 : 54,
          parallelAxisDefault: {
            nameLocation: wide ? "end" : "middle", nameTextStyle: ink, nameGap: wide ? 14 : 24, nameTruncate: { maxWidth: 120 },
            axisLine: { lineStyle: { color: css("--dim") } }, axisLabel: { ...ink, hideOverlap: true }, areaSelectStyle: { width: 16, color: "#D55E00", opacity: 0.25 }, realtime: false,
          },
        },
        parallelAxis: axes,
        series: [{
          type: "parallel", smooth: false, lineStyle: { width: 1.3, opacity: 0.75 }, inactiveOpacity: 0.06, activeOpacity: 0.85, emphasis: { lineStyle: { width: 3.5, opacity: 1 } },
          data: marks.map((mark) => ({ value: mark.values, mark, lineStyle: { color: tone(mark.colour) } })),
        }],
      }),
    };
  }

  function optionsOf(chart, name, wide) {
    const look = chart.styles.map(({ colour, dash, ...style }) => (hidden[name]?.has(style.name) ? null : { color: tone(colour), type: DASHES[dash], ...style }));
    return chart.panels.map((panel) => {
      const made = { plot, bars, parallel: () => parallel(panel, wide) }[panel.kind](panel, look, name, chart.panels.length === 1);
      if (chart.zoom) made.option.dataZoom = zoom();
      return { ...made, kind: panel.kind, title: panel.title };
    });
  }

  // ---- what is under the pointer

  const tip = Object.assign(document.createElement("div"), { className: "tip", hidden: true });
  tip.setAttribute("aria-hidden", "true"); // the tables say the same
  document.body.append(tip);
  // The point of a line that is closest to the pointer, within 24 pixels: {index of its series, text, trial}.
  function nearest(chart, series, x, y) {
    const inside = { gridIndex: 0 };
    const [[left, bottom], [right, top]] = [[x - 24, y + 24], [x + 24, y - 24]].map((p) => chart.convertFromPixel(inside, p));
    let best = null, least = 24 ** 2;
    series.forEach((one, index) => {
      if (!one.says) return;
      one.data.forEach(([at, value]) => {
        if (value === null || at < left || at > right || value < bottom || value > top) return;
        const [px, py] = chart.convertToPixel(inside, [at, value]);
        const far = (px - x) ** 2 + (py - y) ** 2;
        if (far < least) [best, least] = [{ index, text: one.says(at, value), trial: one.trial }, far];
      });
    });
    return best;
  }
  function follow(chart, box) {
    const end = () => {
      tip.hidden = true;
      chart.dispatchAction({ type: "downplay" });
    };
    let last = -1;
    chart.getZr().on("mousemove", (event) => {
      const inside = chart.containPixel({ gridIndex: 0 }, [event.offsetX, event.offsetY]);
      const line = inside ? nearest(chart, drawn.get(box).series, event.offsetX, event.offsetY) : null;
      const index = line ? line.index : -1;
      if (index !== last) {
        chart.dispatchAction({ type: "downplay" });
        last = index;
        if (line) chart.dispatchAction({ type: "highlight", seriesIndex: index });
      }
      tip.hidden = !line;
      if (!line) return;
      tip.textContent = line.text;
      const frame = box.getBoundingClientRect();
      const [x, y] = [frame.left + event.offsetX + 14, frame.top + event.offsetY + 14];
      tip.style.left = `${Math.max(4, Math.min(x, document.documentElement.clientWidth - tip.offsetWidth - 4))}px`;
      tip.style.top = `${Math.min(y, innerHeight - tip.offsetHeight - 4)}px`;
    });
    chart.getZr().on("globalout", end);
    chart.getZr().on("click", (event) => {
      const line = nearest(chart, drawn.get(box).series, event.offsetX, event.offsetY);
      if (line) pick(line.trial);
    });
  }

  // ---- controls of a figure, all of them buttons

  function button(text, act, more = {}) {
    const made = document.createElement("button");
    made.type = "button";
    made.textContent = text;
    for (const [key, value] of Object.entries(more)) made.setAttribute(key, value);
    made.addEventListener("click", act);
    return made;
  }

  function legend(styles, name, element) {
    const off = (hidden[name] ??= new Set());
    const list = document.createElement("div");
    list.className = "legend";
    styles.forEach((style, i) => {
      if (!style.name) return;
      const entry = button(style.name, () => {
        if (!off.delete(style.name)) off.add(style.name);
        drawFigure(element);
        element.querySelector(`.legend [data-style="${i}"]`).focus();
      }, { "aria-pressed": String(!off.has(style.name)), "data-style": i });
      entry.style.setProperty("--colour", tone(style.colour));
      entry.classList.add("entry");
      if (style.dash !== "-") entry.classList.add("dashed");
      list.append(entry);
    });
    return list;
  }

  // Where curves leave an axis: how many do, and a box that shows them whole.
  function leaving(floor, name, element) {
    const check = Object.assign(document.createElement("input"), { type: "checkbox", checked: whole.has(name) });
    check.addEventListener("change", () => {
      if (!whole.delete(name)) whole.add(name);
      drawFigure(element);
      element.querySelector(".tools input").focus();
    });
    const box = document.createElement("label");
    box.append(check, " show all of them");
    return [Object.assign(document.createElement("span"), { className: "leaves", textContent: floor.text }), " ", box];
  }

  function range(chart) {
    const zooms = chart.getOption()?.dataZoom || [];
    return zooms.map((z) => [z.start ?? 0, z.end ?? 100]);
  }
  // factor: of the shown range; shift: in shares of it. Along x; null shows everything in both directions.
  function move(chart, factor, shift) {
    if (factor === null) return [0, 1].forEach((i) => chart.dispatchAction({ type: "dataZoom", dataZoomIndex: i, start: 0, end: 100 }));
    const [start, end] = range(chart)[0];
    const width = Math.min(100, Math.max(0.5, (end - start) * factor));
    const first = Math.min(100 - width, Math.max(0, (start + end) / 2 + shift * (end - start) - width / 2));
    chart.dispatchAction({ type: "dataZoom", dataZoomIndex: 0, start: first, end: first + width });
  }
  const KEYS = { "+": [0.5, 0], "=": [0.5, 0], "-": [2, 0], ArrowLeft: [1, -0.25], ArrowRight: [1, 0.25], 0: [null, 0], Escape: [null, 0] };

  // An empty chart in a place of its own, which answers to pointer and keys.
  function addChart(room, made) {
    const holder = document.createElement("div");
    holder.className = made.half ? "holder half" : "holder";
    if (made.title) holder.append(Object.assign(document.createElement("p"), { className: "heading", textContent: made.title }));
    const box = document.createElement("div");
    box.className = "chart";
    box.style.height = `${made.height}px`;
    box.tabIndex = 0;
    box.setAttribute("role", "img");
    box.setAttribute("aria-label", `${made.title ? `${made.title}: ` : ""}chart${made.option.dataZoom ? "; plus and minus zoom, arrows move, 0 shows all" : ""}`);
    holder.append(box);
    room.append(holder);
    const chart = echarts.init(box, null, { renderer: "canvas" });
    drawn.set(box, { chart });
    chart.on("click", (p) => pick(p.data?.mark?.trial));
    if (made.kind === "plot") follow(chart, box);
    box.addEventListener("keydown", (event) => {
      if (!(event.key in KEYS) || event.ctrlKey || event.metaKey || !range(chart).length) return;
      event.preventDefault();
      move(chart, ...KEYS[event.key]);
    });
    box.addEventListener("dblclick", () => range(chart).length && move(chart, null, 0));
    if (made.brush) chart.on("axisareaselected", () => {
      const active = chart.getModel().getSeries()[0].getRawIndicesByActiveState("active");
      const data = chart.getOption().series[0].data;
      brushed(active.length === 0 || active.length === data.length ? null : active.map((at) => data[at].mark.trial));
    });
  }

  // The figure as it is shown, with its legend, headings and notes, for print and papers.
  function save(element) {
    const sharp = 3;
    const room = element.querySelector(".charts");
    const frame = room.getBoundingClientRect();
    const canvas = Object.assign(document.createElement("canvas"), { width: sharp * frame.width, height: sharp * frame.height });
    const ink = canvas.getContext("2d");
    ink.scale(sharp, sharp);
    ink.fillStyle = css("--paper");
    ink.fillRect(0, 0, frame.width, frame.height);
    ink.textBaseline = "middle";
    room.querySelectorAll(".chart, .heading, .entry[aria-pressed=true], .leaves").forEach((part) => {
      const place = part.getBoundingClientRect();
      const [left, middle] = [place.left - frame.left, place.top - frame.top + place.height / 2];
      if (part.classList.contains("chart")) return ink.drawImage(drawn.get(part).chart.renderToCanvas({ pixelRatio: sharp }), left, place.top - frame.top, place.width, place.height);
      const colour = part.style.getPropertyValue("--colour");
      if (colour) {
        Object.assign(ink, { strokeStyle: colour, lineWidth: 3 });
        ink.setLineDash(part.classList.contains("dashed") ? [5, 3] : []);
        ink.beginPath();
        ink.moveTo(left, middle);
        ink.lineTo(left + 16, middle);
        ink.stroke();
      }
      ink.font = getComputedStyle(part).font;
      ink.fillStyle = css("--ink");
      ink.fillText(part.textContent, left + (colour ? 22 : 0), middle);
    });
    Object.assign(document.createElement("a"), { href: canvas.toDataURL(), download: `${element.dataset.figure}.png` }).click();
  }

  function drawFigure(element) {
    const name = element.dataset.figure;
    const description = charts[name];
    const room = element.querySelector(".charts");
    const made = optionsOf(description, name, element.clientWidth > 560);
    const shape = JSON.stringify(made.map((m) => [m.title, m.height]));
    const again = room.dataset.shape === shape;
    if (!again) {
      room.querySelectorAll(".chart").forEach((box) => { drawn.get(box)?.chart.dispose(); drawn.delete(box); });
      room.replaceChildren();
      made.forEach((m) => addChart(room, m));
      room.dataset.shape = shape;
    }
    room.querySelectorAll(".legend, .tools").forEach((old) => old.remove());
    room.querySelectorAll(".chart").forEach((box, i) => {
      const { option, brush } = made[i];
      const { chart } = drawn.get(box);
      drawn.get(box).series = option.series;
      if (!again) chart.resize(); // its neighbours have come since
      const zooms = range(chart);
      if (zooms.length && option.dataZoom) option.dataZoom.forEach((z, way) => { [z.start, z.end] = zooms[way] || [0, 100]; });
      chart.setOption(option, { replaceMerge: brush ? ["series"] : ["series", "xAxis", "yAxis"] });
    });
    if (description.styles.some((style) => style.name)) room.prepend(legend(description.styles, name, element));
    const tools = document.createElement("div");
    tools.className = "tools";
    description.panels.forEach((panel) => { if (panel.y?.floor) tools.append(...leaving(panel.y.floor, name, element)); });
    if (description.zoom) {
      const every = (factor) => () => room.querySelectorAll(".chart").forEach((box) => move(drawn.get(box).chart, factor, 0));
      tools.append(button("+", every(0.5), { "aria-label": "zoom in" }), button("−", every(2), { "aria-label": "zoom out" }), button("all", every(null), { "aria-label": "show the whole range" }));
    }
    if (made.some((m) => m.brush)) tools.append(Object.assign(document.createElement("span"), { textContent: "Drag along an axis to show only the trials that pass there; click the axis to show all." }));
    tools.append(button("PNG", () => save(element), { "aria-label": "save this figure as PNG" }));
    room.append(tools);
  }

  // ---- filter

  let passing = null; // trials that pass the axes of the parallel coordinates
  const field = () => document.getElementById("words");
  const parallels = () => [...document.querySelectorAll("figure[data-figure]")].filter((element) => charts[element.dataset.figure].panels.some((panel) => panel.kind === "parallel"));
  function matching(text) {
    const parts = text.toLowerCase().split(/\s+/).filter(Boolean);
    if (!parts.length) return null;
    return trials.map((t, place) => [`${t[0]} ${t[1]} ${t[2]} seed=${t[3]} ${t[4]}`.toLowerCase(), place]).filter(([hay]) => parts.every((part) => hay.includes(part))).map(([, place]) => place);
  }
  function filter(except) {
    const matches = matching(field().value);
    const passes = (place) => passing === null || passing.has(place);
    shown = matches === null && passing === null ? null : new Set((matches ?? [...trials.keys()]).filter(passes));
    const size = shown === null ? trials.length : shown.size;
    document.getElementById("shown").textContent = shown === null ? `all ${size}` : `${size} of ${trials.length}`;
    document.querySelectorAll("tr[data-trial]").forEach((row) => { row.hidden = shown !== null && !shown.has(+row.dataset.trial); });
    draw(except);
  }
  function pick(trial) {
    if (trial === undefined || trial === null) return;
    field().value = trials[trial][1];
    filter();
  }
  function brushed(places) {
    passing = places === null ? null : new Set(places);
    filter(parallels()); // drawn again, they would lose what is selected
  }
  function reset() {
    field().value = "";
    passing = null;
    // A selection lives in the axes: without them it is gone.
    parallels().forEach((element) => element.querySelectorAll(".chart").forEach((box) => drawn.get(box).chart.clear()));
    filter();
  }

  function draw(except = []) {
    document.querySelectorAll("figure[data-figure]").forEach((element) => { if (!except.includes(element)) drawFigure(element); });
  }
  function load() {
    ({ trials, charts } = JSON.parse(document.getElementById("data").textContent));
    for (const box of drawn.keys()) if (!box.isConnected) { drawn.get(box).chart.dispose(); drawn.delete(box); }
    filter();
  }
  function resize() {
    drawn.forEach(({ chart }) => chart.resize());
  }
  return { load, draw, filter, reset, resize, pick, chart: (box) => drawn.get(box)?.chart };
})();
