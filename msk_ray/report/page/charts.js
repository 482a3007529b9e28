"use strict";
// Charts of the figures, drawn by Apache ECharts from the data in the page. `page.draw()` draws all that is on it.
const page = (() => {
  let trials = []; // [experiment, id, variant, seed, outcome, score], by position
  let figures = {};
  let shown = null; // positions of the trials to show; null: all
  const hidden = {}; // figure → names of variants switched off
  const whole = new Set(); // figures whose axes show curves that leave them
  const drawn = new Map(); // element → {chart, option}
  const GREY = "#9a9a9a";
  const GRID = { left: 12, right: 18, top: 26, bottom: 30, containLabel: true };
  const VIRIDIS = ["#440154", "#472f7d", "#39568c", "#287c8e", "#1f988b", "#35b779", "#7ad151", "#bddf26"];

  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const visible = (place) => shown === null || shown.has(place);
  const label = (place) => {
    const [experiment, id, variant, seed, outcome] = trials[place];
    const several = new Set(trials.map((t) => t[0])).size > 1;
    return `${several ? `${experiment}: ` : ""}${id}\n${variant}, seed ${seed}, ${outcome}`;
  };
  const steps = (v) => {
    const size = Math.abs(v);
    const [unit, name] = size >= 1e9 ? [1e9, "G"] : size >= 1e6 ? [1e6, "M"] : size >= 1e3 ? [1e3, "k"] : [1, ""];
    return `${+(v / unit).toPrecision(4)}${name}`;
  };
  const number = (v) => (Math.abs(v) >= 1e5 || (v !== 0 && Math.abs(v) < 1e-3) ? v.toExponential(2).replace(/\.?0+e/, "e") : String(+v.toPrecision(5)));
  // Text, never markup: names come from people.
  const bubble = (text) => {
    const box = document.createElement("div");
    box.textContent = text;
    box.style.cssText = "white-space: pre-wrap; max-width: 20rem; overflow-wrap: anywhere";
    return box;
  };
  const mix = (share) => {
    const at = Math.min(0.999, Math.max(0, share)) * (VIRIDIS.length - 1);
    const [a, b] = [VIRIDIS[Math.floor(at)], VIRIDIS[Math.floor(at) + 1]];
    const part = (hex, i) => parseInt(hex.slice(1 + 2 * i, 3 + 2 * i), 16);
    return `rgb(${[0, 1, 2].map((i) => Math.round(part(a, i) + (at % 1) * (part(b, i) - part(a, i)))).join(",")})`;
  };
  // Without the end of the colours that is hard to see on this paper.
  const scoreColour = (share) => mix(css("--dark") === "1" ? 0.22 + 0.78 * share : 0.88 * share);

  const axis = (name, more = {}) => ({
    type: "value", scale: true, name, nameLocation: "middle", nameGap: 28,
    nameTextStyle: { color: css("--dim") }, axisLabel: { color: css("--ink"), hideOverlap: true },
    axisLine: { show: true, onZero: false, lineStyle: { color: css("--dim") } }, splitLine: { lineStyle: { color: css("--grid") } }, ...more,
  });
  const stepsAxis = (name, more = {}) => axis(name, { axisLabel: { color: css("--ink"), formatter: steps, hideOverlap: true }, min: 0, ...more });
  // Zooming by the wheel only with Ctrl: without it, the wheel scrolls the page. A finger scrolls it too.
  const zoom = () => [0, 1].map((way) => ({
    type: "inside", [way ? "yAxisIndex" : "xAxisIndex"]: 0, filterMode: "none", zoomOnMouseWheel: "ctrl",
    moveOnMouseMove: matchMedia("(pointer: fine)").matches, moveOnMouseWheel: false, preventDefaultMouseMove: false,
  }));
  const base = (more) => ({
    animation: false, backgroundColor: "transparent", textStyle: { fontFamily: "inherit", color: css("--ink") },
    grid: GRID,
    tooltip: {
      trigger: "item", confine: true, backgroundColor: css("--paper"), borderColor: css("--line"),
      textStyle: { color: css("--ink"), fontSize: 13 }, formatter: (p) => bubble(p.data.says),
    }, ...more,
  });
  // Points are found by `nearest`: a symbol for each would make large charts slow.
  const line = (place, x, y, style, says) => ({
    type: "line", symbol: "circle", symbolSize: 5, showSymbol: x.length === 1, lineStyle: style, itemStyle: { color: style.color },
    emphasis: { focus: "series", lineStyle: { width: (style.width || 1) + 1.5 } }, silent: true, data: x.map((at, i) => [at, y[i]]), place, says,
  });

  const chartsOf = {
    curves(figure, name) {
      const off = hidden[name] || new Set();
      const lines = new Map(figure.lines.map((l) => [l[0], l]));
      const series = [];
      const each = shown !== null;
      const alone = figure.variants.length > 60 ? 0.35 : 0.6;
      for (const variant of [...figure.variants].reverse()) {
        if (off.has(variant.colour ? variant.name : "")) continue;
        const own = variant.trials.filter((place) => visible(place));
        if (!own.length) continue;
        const type = { "-": "solid", "--": "dashed", "-.": [8, 3, 2, 3], ":": "dotted" }[variant.dash];
        const style = { color: variant.colour || GREY, width: variant.colour ? 2 : 0.8, type, opacity: variant.colour ? 1 : alone };
        if (variant.mean && !each) {
          const [x, mean, low, high] = variant.mean;
          const band = { type: "line", stack: variant.name, symbol: "none", silent: true, lineStyle: { opacity: 0 }, data: x.map((at, i) => [at, low[i]]), stackStrategy: "all", z: 1 };
          series.push(band, { ...band, data: x.map((at, i) => [at, high[i] - low[i]]), areaStyle: { color: variant.colour, opacity: 0.16 } });
          series.push({
            ...line(own[0], x, mean, style, (at, y) => `${variant.name}\nmean of ${own.length} seeds: ${number(y)} at ${steps(at)} ${figure.x}`),
            place: undefined, z: 3,
          });
        } else {
          for (const place of own) {
            const [, x, y] = lines.get(place);
            series.push({ ...line(place, x, y, style, (at, v) => `${label(place)}\n${number(v)} at ${steps(at)} ${figure.x}`), z: variant.colour ? 3 : 2 });
          }
        }
        if (!variant.colour) continue;
        const ends = own.filter((place) => lines.get(place)[3]).map((place) => {
          const [, x, y] = lines.get(place);
          return { value: [x[x.length - 1], y[y.length - 1]], says: `${label(place)}\nended here`, place };
        });
        if (ends.length) series.push({ type: "scatter", symbol: "path://M0,0L2,0L6,4L10,0L12,0L12,2L8,6L12,10L12,12L10,12L6,8L2,12L0,12L0,10L4,6L0,2Z", symbolSize: 9, itemStyle: { color: variant.colour }, data: ends, z: 4 });
      }
      const floor = figure.floor && !whole.has(name) ? figure.floor.at : undefined;
      return [{ option: base({ xAxis: stepsAxis(figure.x), yAxis: axis(figure.y, { nameGap: 56, min: floor }), grid: { ...GRID, left: 34 }, dataZoom: zoom(), series }), height: 400 }];
    },
    effects(figure) {
      const top = { left: 12, right: 70, top: 8, bottom: 30, containLabel: true };
      const made = [{
        title: "ranking", height: 120 + 26 * figure.ranking.length,
        option: base({
          grid: top, xAxis: axis(figure.x, { scale: false, min: 0, max: figure.x.startsWith("share") ? 1 : undefined }),
          yAxis: axis("", { type: "category", inverse: true, data: figure.ranking.map((r) => r.name), axisLabel: { color: css("--ink"), width: 110, overflow: "truncate" } }),
          series: [{
            type: "bar", barMaxWidth: 18, label: { show: true, position: "right", color: css("--ink"), formatter: (p) => figure.ranking[p.dataIndex].text },
            data: figure.ranking.map((r) => ({ value: r.value, says: `${r.name}: ${r.text}`, itemStyle: { color: r.seed ? GREY : css("--bar") } })),
          }],
        }),
      }];
      for (const panel of figure.panels) {
        const points = [], means = [], ranges = [];
        panel.levels.forEach((level, i) => {
          level.points.forEach(([place, score, cut], j) => {
            if (!visible(place)) return;
            const aside = level.points.length > 1 ? 0.3 * (j / (level.points.length - 1) - 0.5) : 0;
            points.push({ value: [i + aside, score], says: `${label(place)}\nbest score ${number(score)}${cut ? " so far: stopped before its end" : ""}`, place, itemStyle: cut ? { color: "transparent", borderColor: css("--dim"), borderWidth: 1.5 } : { color: css("--dim") } });
          });
          const words = `${panel.title} = ${level.label}\nmean ${number(level.mean)}${level.interval ? `, 95 % interval ${number(level.interval[0])} … ${number(level.interval[1])}` : ""}`;
          means.push({ value: [i, level.mean], says: words });
          if (level.interval) ranges.push({ type: "line", silent: true, symbol: "none", lineStyle: { color: "#D55E00", width: 1.6 }, data: level.interval.map((v) => [i, v]) });
        });
        const named = (v) => (Number.isInteger(v) && panel.levels[v] ? panel.levels[v].label : "");
        made.push({
          title: panel.title, heading: panel.title, half: true, height: 260,
          option: base({
            xAxis: axis("", { min: -0.6, max: panel.levels.length - 0.4, interval: 1, scale: false, splitLine: { show: false }, axisTick: { show: false },
              axisLabel: { color: css("--ink"), formatter: named, customValues: panel.levels.map((_, i) => i), rotate: panel.levels.length > 4 ? 35 : 0, width: 90, overflow: "truncate" } }),
            yAxis: axis("best score", { nameGap: 56 }), grid: { ...GRID, left: 34 },
            series: [...ranges, { type: "scatter", symbol: "rect", symbolSize: [26, 3], itemStyle: { color: "#D55E00" }, data: means }, { type: "scatter", symbolSize: 7, data: points }],
          }),
        });
      }
      return made;
    },
    parallel(figure, name, wide) {
      const scores = figure.trials.map((t) => t[1]);
      const [low, high] = [Math.min(...scores), Math.max(...scores)];
      const parallelAxis = figure.axes.map((a, dim) => ({
        dim, name: a.name, ...(a.levels ? { type: "category", data: a.levels } : { type: a.log ? "log" : "value", scale: true, min: a.log ? Math.min(...a.values) : undefined, max: a.log ? Math.max(...a.values) : undefined, axisLabel: { formatter: number, color: css("--ink"), hideOverlap: true } }),
      }));
      parallelAxis.push({ dim: figure.axes.length, name: "best score", type: "value", scale: true });
      const order = figure.trials.map((_, i) => i).filter((i) => visible(figure.trials[i][0])).sort((a, b) => scores[a] - scores[b]);
      return [{
        height: wide ? 380 : 90 + 110 * parallelAxis.length, brush: true,
        option: base({
          parallel: {
            layout: wide ? "horizontal" : "vertical", left: wide ? 40 : 24, right: wide ? 70 : 30, top: wide ? 40 : 16, bottom: wide ? 24 : 54,
            parallelAxisDefault: {
              nameLocation: wide ? "end" : "middle", nameTextStyle: { color: css("--ink") }, nameGap: wide ? 14 : 24, nameTruncate: { maxWidth: 120 },
              axisLine: { lineStyle: { color: css("--dim") } }, axisLabel: { color: css("--ink"), hideOverlap: true }, areaSelectStyle: { width: 16, color: "#D55E00", opacity: 0.25 }, realtime: false,
            },
          },
          parallelAxis,
          series: [{
            type: "parallel", smooth: false, lineStyle: { width: 1.3, opacity: 0.75 }, inactiveOpacity: 0.06, activeOpacity: 0.85, emphasis: { lineStyle: { width: 3.5, opacity: 1 } },
            data: order.map((i) => ({
              value: [...figure.axes.map((a) => (a.levels ? a.levels[a.values[i]] : a.values[i])), scores[i]], place: figure.trials[i][0],
              says: `${label(figure.trials[i][0])}\nbest score ${number(scores[i])}`, lineStyle: { color: scoreColour((scores[i] - low) / (high - low || 1)) },
            })),
          }],
        }),
      }];
    },
    stops(figure) {
      const bars = figure.bars.filter(([place]) => visible(place));
      const kinds = Object.keys(figure.outcomes).filter((kind) => bars.some(([place]) => trials[place][4] === kind));
      const series = kinds.map((kind) => ({
        type: "bar", name: kind, stack: "all", barMaxWidth: 14, itemStyle: { color: figure.outcomes[kind] },
        data: bars.map(([place, end]) => (trials[place][4] === kind ? { value: end, place, says: `${label(place)}\nended at ${steps(end)} env steps${trials[place][5] === null ? "" : `, best score ${number(trials[place][5])}`}` } : null)),
      }));
      if (series.length) series[0].markLine = {
        silent: true, symbol: "none", label: { formatter: "rung", position: "start", color: css("--dim") }, lineStyle: { color: css("--ink"), type: "dotted" }, data: figure.rungs.map((at) => ({ xAxis: at })),
      };
      return [{
        height: 90 + Math.min(620, Math.max(60, 18 * bars.length)), legend: kinds.map((kind) => [kind, figure.outcomes[kind]]),
        option: base({
          xAxis: stepsAxis("env steps"), dataZoom: zoom(), series,
          yAxis: axis("", { type: "category", inverse: true, data: bars.map(([place]) => trials[place][1]), axisLabel: { color: css("--ink"), fontFamily: "monospace", fontSize: 11 } }),
        }),
      }];
    },
    health(figure) {
      const failed = new Set(figure.failed);
      const legend = [["a trial", GREY], ["a trial that failed", "#D55E00"], ["the best trial", css("--bar")]];
      return figure.metrics.map((metric, i) => ({
        title: metric.title, heading: metric.title, half: true, height: 230, legend: i === 0 ? legend : undefined,
        option: base({
          xAxis: stepsAxis("env steps"), yAxis: axis("", { type: metric.log ? "log" : "value", axisLabel: { color: css("--ink"), formatter: number, hideOverlap: true } }), dataZoom: zoom(),
          series: metric.lines.filter(([place]) => visible(place)).map(([place, x, y]) => {
            const best = place === figure.best;
            const style = best ? { color: css("--bar"), width: 1.8 } : failed.has(place) ? { color: "#D55E00", width: 1.1, type: "dashed" } : { color: GREY, width: 0.9, opacity: Math.max(0.25, Math.min(0.8, 12 / metric.lines.length)) };
            const kept = metric.log ? y.map((v) => (v > 0 ? v : null)) : y;
            return { ...line(place, x, kept, style, (at, v) => `${label(place)}\n${v === null ? "" : number(v)} at ${steps(at)} env steps`), z: best ? 4 : 2 };
          }),
        }),
      }));
    },
  };

  // ---- what is under the pointer

  const tip = Object.assign(document.createElement("div"), { className: "tip", hidden: true });
  tip.setAttribute("aria-hidden", "true"); // the tables say the same
  document.body.append(tip);
  // The point of a line that is closest to the pointer, within 24 pixels: {series, at, says, place}.
  function nearest(chart, series, x, y) {
    const inside = { gridIndex: 0 };
    const [[left, bottom], [right, top]] = [[x - 24, y + 24], [x + 24, y - 24]].map((p) => chart.convertFromPixel(inside, p));
    let best = null, least = 24 ** 2;
    series.forEach((one, index) => {
      if (!one.says) return;
      one.data.forEach(([at, value], i) => {
        if (value === null || at < left || at > right || value < bottom || value > top) return;
        const [px, py] = chart.convertToPixel(inside, [at, value]);
        const far = (px - x) ** 2 + (py - y) ** 2;
        if (far < least) [best, least] = [{ index, i, text: one.says(at, value), place: one.place }, far];
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
      const found = chart.containPixel({ gridIndex: 0 }, [event.offsetX, event.offsetY]) ? nearest(chart, drawn.get(box).series, event.offsetX, event.offsetY) : null;
      if ((found ? found.index : -1) !== last) {
        chart.dispatchAction({ type: "downplay" });
        last = found ? found.index : -1;
        if (found) chart.dispatchAction({ type: "highlight", seriesIndex: found.index });
      }
      tip.hidden = !found;
      if (!found) return;
      tip.textContent = found.text;
      const frame = box.getBoundingClientRect();
      const [x, y] = [frame.left + event.offsetX + 14, frame.top + event.offsetY + 14];
      tip.style.left = `${Math.max(4, Math.min(x, document.documentElement.clientWidth - tip.offsetWidth - 4))}px`;
      tip.style.top = `${Math.min(y, innerHeight - tip.offsetHeight - 4)}px`;
    });
    chart.getZr().on("globalout", end);
    chart.getZr().on("click", (event) => {
      const found = nearest(chart, drawn.get(box).series, event.offsetX, event.offsetY);
      if (found && found.place !== undefined) pick(found.place);
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

  function legend(entries, toggle) {
    const list = document.createElement("div");
    list.className = "legend";
    for (const [name, colour, on, key, dashed] of entries) {
      const entry = toggle ? button(name, () => toggle(key ?? name), { "aria-pressed": String(on) }) : document.createElement("span");
      if (!toggle) entry.textContent = name;
      entry.style.setProperty("--colour", colour);
      entry.classList.add("entry");
      if (dashed) entry.classList.add("dashed");
      list.append(entry);
    }
    return list;
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

  function drawFigure(element) {
    const name = element.dataset.figure;
    const figure = figures[name];
    const room = element.querySelector(".charts");
    const wide = element.clientWidth > 560;
    const made = chartsOf[figure.kind](figure, name, wide);
    const again = room.dataset.shape === JSON.stringify(made.map((m) => [m.title, m.height]));
    if (!again) {
      room.querySelectorAll(".chart").forEach((box) => { drawn.get(box)?.chart.dispose(); drawn.delete(box); });
      room.replaceChildren();
    }
    room.querySelectorAll(".legend, .tools").forEach((old) => old.remove());
    made.forEach((m) => {
      if (!again) {
        const holder = document.createElement("div");
        holder.className = m.half ? "holder half" : "holder";
        if (m.heading) holder.append(Object.assign(document.createElement("p"), { className: "heading", textContent: m.heading }));
        const box = document.createElement("div");
        box.className = "chart";
        box.style.height = `${m.height}px`;
        box.tabIndex = 0;
        box.setAttribute("role", "img");
        box.setAttribute("aria-label", `${m.heading ? `${m.heading}: ` : ""}chart${m.option.dataZoom ? "; plus and minus zoom, arrows move, 0 shows all" : ""}`);
        holder.append(box);
        room.append(holder);
        const chart = echarts.init(box, null, { renderer: "canvas" });
        drawn.set(box, { chart });
        chart.on("click", (p) => { if (p.data?.place !== undefined) pick(p.data.place); });
        if (["curves", "health"].includes(figure.kind)) follow(chart, box);
        box.addEventListener("keydown", (event) => {
          if (!(event.key in KEYS) || event.ctrlKey || event.metaKey || !range(chart).length) return;
          event.preventDefault();
          move(chart, ...KEYS[event.key]);
        });
        box.addEventListener("dblclick", () => range(chart).length && move(chart, null, 0));
        if (m.brush) chart.on("axisareaselected", () => {
          const series = chart.getModel().getSeries()[0];
          const active = series.getRawIndicesByActiveState("active");
          const data = chart.getOption().series[0].data;
          brushed(active.length === 0 || active.length === data.length ? null : active.map((at) => data[at].place));
        });
      }
    });
    made.forEach((m, i) => {
      const box = room.querySelectorAll(".chart")[i];
      const { chart } = drawn.get(box);
      drawn.get(box).series = m.option.series;
      if (!again) chart.resize(); // its neighbours have come since
      const zooms = range(chart);
      if (zooms.length && m.option.dataZoom) m.option.dataZoom.forEach((z, way) => { [z.start, z.end] = zooms[way] || [0, 100]; });
      chart.setOption(m.option, { replaceMerge: m.brush ? ["series"] : ["series", "xAxis", "yAxis"] });
    });
    const tools = document.createElement("div");
    tools.className = "tools";
    if (figure.kind === "curves") {
      const off = (hidden[name] ??= new Set());
      const named = figure.variants.filter((v) => v.colour);
      const rest = figure.variants.length - named.length;
      const entries = named.map((v) => [v.name, v.colour, !off.has(v.name), v.name, v.dash !== "-"]);
      if (rest) entries.push([`${rest} more`, GREY, !off.has(""), ""]);
      room.prepend(legend(entries, (key) => { if (!off.delete(key)) off.add(key); drawFigure(element); keepFocus(element, key); }));
      if (figure.floor) {
        const box = document.createElement("label");
        const check = Object.assign(document.createElement("input"), { type: "checkbox", checked: whole.has(name) });
        check.addEventListener("change", () => { if (!whole.delete(name)) whole.add(name); drawFigure(element); element.querySelector(".tools input").focus(); });
        box.append(check, " show all of them");
        tools.append(Object.assign(document.createElement("span"), { className: "leaves", textContent: figure.floor.text }), " ", box);
      }
    }
    const still = made.find((m) => m.legend);
    if (still) room.prepend(legend(still.legend));
    if (made.some((m) => m.option.dataZoom)) {
      const every = (factor) => () => room.querySelectorAll(".chart").forEach((box) => { const { chart } = drawn.get(box); if (range(chart).length) move(chart, factor, 0); });
      tools.append(button("+", every(0.5), { "aria-label": "zoom in" }), button("−", every(2), { "aria-label": "zoom out" }), button("all", every(null), { "aria-label": "show the whole range" }));
    }
    if (figure.kind === "parallel") tools.append(Object.assign(document.createElement("span"), { textContent: "Drag along an axis to show only the trials that pass there; click the axis to show all." }));
    if (tools.childNodes.length) room.append(tools);
    room.dataset.shape = JSON.stringify(made.map((m) => [m.title, m.height]));
  }
  function keepFocus(element, key) {
    [...element.querySelectorAll(".legend button")].find((b) => b.textContent === key || (key === "" && / more$/.test(b.textContent)))?.focus();
  }

  // ---- filter

  let passing = null; // trials that pass the axes of the parallel coordinates
  const words = () => document.getElementById("words");
  function matching(text) {
    const parts = text.toLowerCase().split(/\s+/).filter(Boolean);
    if (!parts.length) return null;
    return trials.map((t, place) => [`${t[0]} ${t[1]} ${t[2]} seed=${t[3]} ${t[4]}`.toLowerCase(), place]).filter(([hay]) => parts.every((part) => hay.includes(part))).map(([, place]) => place);
  }
  function filter(except) {
    const found = matching(words().value);
    const passes = (place) => passing === null || passing.has(place);
    shown = found === null && passing === null ? null : new Set((found ?? [...trials.keys()]).filter(passes));
    const count = shown === null ? trials.length : shown.size;
    document.getElementById("shown").textContent = shown === null ? `all ${count}` : `${count} of ${trials.length}`;
    document.querySelectorAll("tr[data-trial]").forEach((row) => { row.hidden = !visible(+row.dataset.trial); });
    draw(except);
  }
  function pick(place) {
    words().value = trials[place][1];
    filter();
  }
  function brushed(places) {
    passing = places === null ? null : new Set(places);
    filter("parallel");
  }
  function reset() {
    words().value = "";
    passing = null;
    document.querySelectorAll("figure[data-figure]").forEach((element) => {
      if (figures[element.dataset.figure].kind !== "parallel") return;
      // A selection lives in the axes: without them it is gone.
      element.querySelectorAll(".chart").forEach((box) => drawn.get(box).chart.clear());
    });
    filter();
  }

  function draw(except) {
    document.querySelectorAll("figure[data-figure]").forEach((element) => {
      if (figures[element.dataset.figure].kind !== except) drawFigure(element);
    });
  }
  function load() {
    ({ trials, figures } = JSON.parse(document.getElementById("data").textContent));
    for (const box of drawn.keys()) if (!box.isConnected) { drawn.get(box).chart.dispose(); drawn.delete(box); }
    filter();
  }
  function resize() {
    drawn.forEach(({ chart }) => chart.resize());
  }
  return { load, draw, filter, reset, resize, pick, chart: (box) => drawn.get(box)?.chart };
})();
