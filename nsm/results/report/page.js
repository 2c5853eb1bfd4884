"use strict";
(async () => {
  const PALETTE = [
    "#4c78d8", "#f08a24", "#2fa36b", "#d94a5a", "#9467d1",
    "#a0714f", "#e377c2", "#7f8896", "#b0b32e", "#22a9c0",
  ];
  const DASHES = ["solid", "dash", "dot", "dashdot"];
  const VIEWS = 6; // browsers limit the 3D contexts of a page
  const MISSING = "—";
  const FOLDED = 60; // characters of a setting that are shown

  const $ = (selector) => document.querySelector(selector);
  // all content of files enters the page here, as text
  const make = (tag, properties = {}, ...children) => {
    const element = Object.assign(document.createElement(tag), properties);
    element.append(...children);
    return element;
  };
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const decompressed = (id) => {
    const packed = new Blob([bytes($("#" + id).textContent)]);
    return new Response(packed.stream().pipeThrough(new DecompressionStream("gzip"))).text();
  };
  const short = (text, length) =>
    String(text).length > length ? String(text).slice(0, length - 1) + "…" : String(text);
  // plotly interprets some markup in labels
  const label = (text) => short(text, 44).replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");

  const { title, up, sweeps, tasks, incomplete, arrays } = JSON.parse(await decompressed("content"));
  const array = (index) => {
    const stored = arrays[index];
    if (!stored.values) {
      const kinds = { u2: Uint16Array, u4: Uint32Array, f4: Float32Array };
      stored.values = new kinds[stored.type](bytes(stored.data).buffer);
    }
    return stored.values;
  };

  let task = tasks[0];
  for (const one of tasks) {
    one.off = new Set(); // hidden runs
    one.open = new Set(); // runs with expanded settings
    one.filters = new Map();
    one.search = "";
    one.sort = null;
    one.runs.forEach((run, n) => {
      run.colour = PALETTE[n % PALETTE.length];
      run.dash = DASHES[Math.floor(n / PALETTE.length) % DASHES.length];
    });
  }
  const choices = { axis: "steps", log: true, all: false, up };

  // ---- controls
  const control = (section, ...elements) => $(section + " .controls").replaceChildren(...elements);
  const select = (caption, options, key, changed) => {
    if (!options.includes(choices[key])) choices[key] = options[0];
    const box = make("select");
    for (const option of options) box.append(make("option", { value: option, textContent: option }));
    box.value = choices[key] ?? "";
    box.onchange = () => { choices[key] = box.value; changed(); };
    return make("label", {}, caption, box);
  };
  const tick = (caption, key, changed) => {
    const box = make("input", { type: "checkbox", checked: choices[key] });
    box.onchange = () => { choices[key] = box.checked; changed(); };
    return make("label", {}, box, caption);
  };

  // ---- table
  const columns = () => [
    { key: "name", title: "run", first: true, of: (run) => run.label },
    ...task.differing.map((key) => ({ key, title: key, of: (run) => run.settings[key] ?? null })),
    ...task.figures
      .filter((figure) => figure.main || choices.all)
      .map((figure) => ({ ...figure, title: figure.label, number: true, of: (run) => run.figures[figure.key] ?? null })),
  ];
  const shown = (value) => {
    if (value === null) return MISSING;
    if (typeof value !== "number") return value;
    return value !== 0 && Math.abs(value) < 1e-4 ? value.toExponential(2) : String(Number(value.toPrecision(4)));
  };
  const passes = (value, filter) => {
    const match = /^\s*(<=|>=|<|>|=)\s*(-?\d*\.?\d+(?:e[-+]?\d+)?)\s*$/i.exec(filter);
    if (!match) return String(shown(value)).toLowerCase().includes(filter.trim().toLowerCase());
    if (typeof value !== "number") return false;
    const bound = Number(match[2]);
    return { "<": value < bound, ">": value > bound, "<=": value <= bound, ">=": value >= bound, "=": value === bound }[match[1]];
  };
  const compare = (a, b) => {
    if (a === null || b === null) return (a === null) - (b === null);
    if (typeof a === "number" && typeof b === "number") return a - b;
    return String(a).localeCompare(String(b), undefined, { numeric: true });
  };
  // the runs that pass the filters, in the order of the table
  const listed = () => {
    const all = columns();
    const kept = task.runs.filter((run) =>
      all.every((column) => !task.filters.get(column.key) || passes(column.of(run), task.filters.get(column.key))) &&
      [run.name, run.label, ...Object.values(run.settings).map(shown)].some((text) => String(text).toLowerCase().includes(task.search)));
    const by = task.sort && all.find((column) => column.key === task.sort.key);
    if (!by) return kept;
    const missing = (run) => by.of(run) === null;
    return [...kept].sort((a, b) =>
      missing(a) || missing(b) ? compare(by.of(a), by.of(b)) : (task.sort.down ? -1 : 1) * compare(by.of(a), by.of(b)));
  };
  const visible = () => listed().filter((run) => !task.off.has(run));

  const best = (column, runs) => {
    const values = runs.map(column.of).filter((value) => typeof value === "number");
    if (values.length < 2 || new Set(values).size < 2) return null;
    if (column.best === "low") return Math.min(...values);
    if (column.best === "high") return Math.max(...values);
    return column.best === "zero" ? values.reduce((a, b) => (Math.abs(b) < Math.abs(a) ? b : a)) : null;
  };
  const dot = (run) => {
    const mark = make("span", { className: "dot" });
    mark.style.background = run.colour;
    return mark;
  };

  const head = () => {
    const names = make("tr"), filters = make("tr");
    for (const column of columns()) {
      const button = make("button", { type: "button", title: column.key, textContent: column.title });
      if (column.unit) button.append(make("small", { textContent: column.unit }));
      button.onclick = () => {
        const again = task.sort?.key === column.key;
        task.sort = again && task.sort.down ? null : { key: column.key, down: again };
        mark();
        update();
      };
      const kind = (column.number ? "number" : "setting") + (column.first ? " first" : "");
      const cell = make("th", { className: kind, scope: "col" }, button);
      cell.dataset.key = column.key;
      names.append(cell);
      const field = make("input", { type: "search", placeholder: column.number ? "<" : "", value: task.filters.get(column.key) ?? "" });
      field.setAttribute("aria-label", "filter " + column.title);
      field.oninput = () => { task.filters.set(column.key, field.value.trim()); update(); };
      filters.append(make("th", { className: column.first ? "first" : "" }, field));
    }
    $("#table thead").replaceChildren(names, filters);
    mark();
  };
  const mark = () => {
    for (const cell of document.querySelectorAll("#table th[data-key]")) {
      const direction = task.sort?.down ? "descending" : "ascending";
      cell.setAttribute("aria-sort", task.sort?.key === cell.dataset.key ? direction : "none");
    }
  };

  const body = () => {
    const all = columns(), runs = listed(), rows = [];
    const bests = new Map(all.map((column) => [column.key, best(column, runs)]));
    for (const run of runs) {
      const row = make("tr", { className: task.off.has(run) ? "off" : "" });
      for (const column of all) {
        const value = column.of(run);
        if (column.first) {
          const box = make("input", { type: "checkbox", checked: !task.off.has(run) });
          box.setAttribute("aria-label", "show " + run.label);
          box.onchange = () => { task.off[box.checked ? "delete" : "add"](run); update(); };
          const name = make("button", { type: "button", title: run.name, textContent: run.label });
          name.onclick = () => { task.open[task.open.has(run) ? "delete" : "add"](run); body(); };
          row.append(make("td", { className: "first" }, make("div", {}, box, dot(run), name)));
          continue;
        }
        const top = value !== null && value === bests.get(column.key);
        row.append(make("td", { className: (column.number ? "number" : "setting") + (top ? " best" : ""), title: column.number ? "" : shown(value) }, folded(shown(value))));
      }
      rows.push(row);
      if (task.open.has(run)) rows.push(details(run, all.length));
    }
    if (!runs.length) rows.push(make("tr", {}, make("td", { colSpan: all.length, textContent: "no run matches the filters" })));
    $("#table tbody").replaceChildren(...rows);
  };
  // a long text, such as a list of paths, opens on a click
  const folded = (text) => String(text).length <= FOLDED ? String(text) :
    make("details", {}, make("summary", { textContent: short(text, FOLDED) }), String(text));
  const details = (run, width) => {
    const list = make("dl");
    for (const [key, value] of [["path", run.name], ...Object.entries(run.settings)]) {
      list.append(make("div", {}, make("dt", { textContent: key }), make("dd", {}, folded(shown(value)))));
    }
    return make("tr", { className: "details" }, make("td", { colSpan: width }, list));
  };

  // ---- seeds
  const drawSeeds = () => {
    $("#seeds").hidden = !task.seeds.length;
    const figures = task.figures.filter((figure) => (figure.main || choices.all) && task.seeds.some((group) => group.figures[figure.key]));
    const head = make("tr", {}, make("th", { className: "first", textContent: "runs" }), make("th", { className: "number", textContent: "seeds" }),
      ...figures.map((figure) => make("th", { className: "number", textContent: figure.label }, make("small", { textContent: figure.unit }))));
    $("#seeds thead").replaceChildren(head);
    $("#seeds tbody").replaceChildren(...task.seeds.map((group) => make("tr", {}, make("td", { className: "first", textContent: group.label }),
      make("td", { className: "number", textContent: group.runs.length }),
      ...figures.map((figure) => {
        const known = group.figures[figure.key];
        return make("td", { className: "number", textContent: known ? `${shown(known[0])} ± ${shown(known[1])}` : MISSING });
      }))));
  };

  // ---- plots
  const colours = () => {
    const style = getComputedStyle(document.documentElement);
    return (name) => style.getPropertyValue("--" + name).trim();
  };
  const CONFIG = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["select2d", "lasso2d"] };
  const layout = (x, y) => {
    const colour = colours();
    const axis = { gridcolor: colour("line"), linecolor: colour("line"), zerolinecolor: colour("line"), automargin: true };
    return {
      paper_bgcolor: "transparent", plot_bgcolor: "transparent",
      font: { color: colour("ink"), family: "system-ui, sans-serif", size: 12 },
      margin: { l: 60, r: 10, t: 32, b: 45 }, hovermode: "closest",
      modebar: { bgcolor: "transparent", color: colour("faint"), activecolor: colour("accent") },
      hoverlabel: { namelength: -1 }, legend: { itemclick: false, itemdoubleclick: false },
      showlegend: true, xaxis: { ...axis, ...x }, yaxis: { ...axis, ...y },
    };
  };
  const numbered = { exponentformat: "power", tickformat: "~g" };

  const drawCurves = () => {
    const tags = [...new Set(task.runs.flatMap((run) => Object.keys(run.curves)))];
    $("#curves").hidden = !tags.length;
    if (!tags.length) return;
    const drawn = tags.filter((tag) => task.runs.some((run) => run.curves[tag]?.steps.length > 1));
    const first = ["val/rms_percent", "val/distortion"].find((tag) => drawn.includes(tag)) ??
      drawn.find((tag) => tag.startsWith("val/")) ?? [...drawn, ...tags].find((tag) => tag === "train/loss") ?? drawn[0] ?? tags[0];
    const timed = task.runs.some((run) => Object.values(run.curves).some((curve) => curve.seconds));
    if (!tags.includes(choices.tag)) choices.tag = first;
    control("#curves", select("curve", tags, "tag", drawCurves),
      select("x axis", timed ? ["steps", "seconds"] : ["steps"], "axis", drawCurves), tick("logarithmic", "log", drawCurves));
    const traces = visible()
      .filter((run) => run.curves[choices.tag]?.[choices.axis])
      .map((run) => ({
        x: run.curves[choices.tag][choices.axis], y: run.curves[choices.tag].values, name: label(run.label),
        mode: run.curves[choices.tag].values.length < 30 ? "lines+markers" : "lines",
        line: { color: run.colour, dash: run.dash, width: 2 },
      }));
    const log = choices.log && traces.some((trace) => trace.y.some((value) => value > 0));
    Plotly.react($("#curves .plot"), traces,
      layout({ title: { text: choices.axis } }, { title: { text: label(choices.tag) }, type: log ? "log" : "linear", ...numbered }), CONFIG);
  };

  const drawDistortion = () => {
    const names = task.histograms.map((one) => one.name);
    $("#distortion").hidden = !names.length;
    if (!names.length) return;
    control("#distortion", select("energy", names, "energy", drawDistortion));
    const { edges, shares } = task.histograms[names.indexOf(choices.energy)];
    const traces = visible()
      .map((run) => [run, shares[task.runs.indexOf(run)]])
      .filter(([, share]) => share)
      .map(([run, share]) => ({
        x: edges, y: [...share, share.at(-1)], name: label(run.label), mode: "lines",
        line: { shape: "hv", color: run.colour, dash: run.dash, width: 1.6 },
      }));
    Plotly.react($("#distortion .plot"), traces,
      layout({ title: { text: choices.energy }, type: "log", ...numbered }, { title: { text: "% of area" } }), CONFIG);
  };

  // ---- pictures
  const enlarged = (src, alt) => {
    const image = make("img", { src, alt });
    image.onclick = () => { $("#large img").src = src; $("#large").showModal(); };
    return image;
  };
  const drawPictures = () => {
    const names = [...new Set(task.runs.flatMap((run) => Object.keys(run.pictures)))];
    $("#pictures").hidden = !names.length;
    if (!names.length) return;
    control("#pictures", select("picture", names, "picture", drawPictures));
    const figures = visible()
      .filter((run) => run.pictures[choices.picture])
      .map((run) => {
        const image = enlarged(run.pictures[choices.picture], choices.picture + " of " + run.label);
        return make("figure", {}, make("figcaption", {}, dot(run), run.label), image);
      });
    $("#pictures .grid").replaceChildren(...figures);
  };
  $("#large").onclick = () => $("#large").close();

  // ---- shapes
  let page = 0;
  const panes = []; // reused, because browsers limit the 3D contexts of a page
  const pane = (n) => {
    while (panes.length <= n) {
      const caption = make("figcaption"), view = make("div", { className: "view" });
      panes.push({ caption, view, figure: make("figure", {}, caption, view) });
    }
    return panes[n];
  };
  let synchronizing = false;
  const synchronize = (source, change) => {
    const camera = change["scene.camera"];
    if (!camera || synchronizing) return;
    synchronizing = true;
    const others = panes.filter((other) => other.view !== source && other.figure.isConnected);
    Promise.all(others.map((other) => Plotly.relayout(other.view, { "scene.camera": camera })))
      .finally(() => { synchronizing = false; });
  };
  const drawShapes = async () => {
    const having = task.runs.filter((run) => run.shapes.length);
    $("#shapes").hidden = !having.length;
    if (!having.length) return;
    const names = [...new Set(having.flatMap((run) => run.shapes.map((shape) => shape.name)))];
    const again = () => { page = 0; drawShapes(); };
    const chosen = select("shape", names, "shape", again);
    const shapes = visible().flatMap((run) =>
      run.shapes.filter((shape) => shape.name === choices.shape).map((shape) => [run, shape]));
    const keys = [...new Set(shapes.flatMap(([, shape]) => Object.keys(shape.colours)))];
    const by = select("colour", [...keys, "none"], "colour", drawShapes);
    const upward = select("up", ["y", "-y", "z", "-z", "x", "-x"], "up", drawShapes);
    const pages = Math.max(1, Math.ceil(shapes.length / VIEWS));
    page = Math.min(page, pages - 1);
    const step = (symbol, to) => make("button", { type: "button", textContent: symbol, disabled: to < 0 || to >= pages, onclick: () => { page = to; drawShapes(); } });
    control("#shapes", chosen, by, upward, ...(pages > 1 ? [step("‹", page - 1), `${page + 1} / ${pages}`, step("›", page + 1)] : []));

    const ranges = shapes.map(([, shape]) => shape.colours[choices.colour]?.range).filter(Boolean);
    const low = Math.min(...ranges.map((range) => range[0])), high = Math.max(...ranges.map((range) => range[1]));
    const here = shapes.slice(page * VIEWS, (page + 1) * VIEWS);
    for (const unused of panes.slice(here.length)) {
      Plotly.purge(unused.view);
      unused.bound = false;
      unused.figure.remove();
    }
    const look = colours();
    for (const [n, [run, shape]] of here.entries()) {
      const { caption, view, figure } = pane(n);
      caption.replaceChildren(dot(run), run.label);
      if (!figure.isConnected) $("#shapes .grid").append(figure);
      const points = array(shape.vertices), corners = array(shape.faces);
      const every = (values, k) => values.filter((_, index) => index % 3 === k);
      const [x, y, z] = [0, 1, 2].map((k) => every(points, k));
      const [i, j, k] = [0, 1, 2].map((m) => every(corners, m));
      const extent = [x, y, z].map((along) => along.reduce((a, b) => Math.max(a, b), -Infinity) - along.reduce((a, b) => Math.min(a, b), Infinity));
      const [ax, ay, az] = extent.map((length) => Math.max(length / Math.max(...extent), 0.01));
      const values = shape.colours[choices.colour];
      const paint = values
        ? {
            intensity: array(values.values), intensitymode: values.of === "faces" ? "cell" : "vertex",
            cmin: low, cmax: high > low ? high : low + 1, colorscale: "Viridis", showscale: true,
            colorbar: { thickness: 10, len: 0.85, tickfont: { color: look("ink") } },
          }
        : { color: "#c5cbd6", showscale: false };
      const frame = shape.frames[choices.up];
      const [tx, ty, tz] = frame.towards, [ux, uy, uz] = frame.up;
      const hidden = { visible: false, showspikes: false };
      await Plotly.react(view,
        [{
          type: "mesh3d", x, y, z, i, j, k, ...paint, hoverinfo: values ? "text+x+y+z" : "skip", hovertemplate: values ? "%{intensity:.4g}<extra></extra>" : undefined,
          flatshading: false, lightposition: { x: 1e5 * (tx + ux), y: 1e5 * (ty + uy), z: 1e5 * (tz + uz) },
          lighting: { ambient: 0.45, diffuse: 0.75, specular: 0.25, roughness: 0.55, fresnel: 0.1 },
        }],
        {
          modebar: { bgcolor: "transparent", color: look("faint"), activecolor: look("accent") },
          paper_bgcolor: "transparent", margin: { l: 0, r: 0, t: 0, b: 0 }, uirevision: task.name + choices.shape + choices.up,
          scene: {
            xaxis: hidden, yaxis: hidden, zaxis: hidden, aspectmode: "manual", aspectratio: { x: ax, y: ay, z: az }, bgcolor: "transparent",
            uirevision: task.name + choices.shape + choices.up,
            camera: { up: { x: ux, y: uy, z: uz }, eye: { x: 1.45 * tx, y: 1.45 * ty, z: 1.45 * tz } },
          },
        }, CONFIG);
      if (!panes[n].bound) {
        panes[n].bound = true;
        view.on("plotly_relayout", (change) => synchronize(view, change));
      }
    }
  };

  // ---- page
  const update = () => {
    body();
    drawSeeds();
    if (!window.Plotly) return;
    drawCurves();
    drawDistortion();
    drawPictures();
    drawShapes();
  };
  const choose = (one) => {
    task = one;
    page = 0;
    for (const button of $("#tasks").children) button.setAttribute("aria-selected", String(button.dataset.name === one.name));
    const search = make("input", { type: "search", placeholder: "search all settings", value: task.search });
    search.setAttribute("aria-label", "search all settings");
    search.oninput = () => { task.search = search.value.trim().toLowerCase(); update(); };
    control("#table", search, tick("all figures", "all", () => { head(); update(); }));
    head();
    update();
  };

  $("h1").textContent = title;
  const count = tasks.reduce((sum, one) => sum + one.runs.length, 0);
  $("#count").textContent = `${count} run${count === 1 ? "" : "s"}` + (incomplete.length ? `, ${incomplete.length} problem${incomplete.length === 1 ? "" : "s"} (see the end of the page)` : "");
  $("#sweeps").hidden = !sweeps.length;
  const warned = tasks.flatMap((one) => one.runs.flatMap((run) => run.warnings.map((text) => [run.label, text])));
  $("#warnings").hidden = !warned.length;
  for (const [name, text] of warned) {
    $("#warnings ul").append(make("li", {}, make("b", { textContent: name + " " }), text));
  }
  for (const sweep of sweeps) {
    $("#sweeps").append(make("figure", {}, make("figcaption", { textContent: sweep.name }), enlarged(sweep.picture, sweep.name)));
  }
  $("#incomplete").hidden = !incomplete.length;
  for (const item of incomplete) {
    $("#incomplete ul").append(make("li", {}, item.name + " ", make("span", { textContent: item.reason })));
  }
  if (tasks.length > 1) {
    for (const one of tasks) {
      const button = make("button", { type: "button", textContent: `${one.name} (${one.runs.length})`, onclick: () => choose(one) });
      button.setAttribute("role", "tab");
      button.dataset.name = one.name;
      $("#tasks").append(button);
    }
  }
  if (!task) {
    for (const id of ["#table", "#curves", "#distortion", "#shapes", "#pictures"]) $(id).hidden = true;
    document.documentElement.dataset.state = "ready";
    return;
  }
  choose(task);
  document.head.append(make("script", { textContent: await decompressed("library") }));
  update();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", update);
  document.documentElement.dataset.state = "ready";
})().catch((error) => {
  document.documentElement.dataset.state = "failed";
  const trouble = document.querySelector("#trouble");
  trouble.hidden = false;
  trouble.textContent = "This page needs a browser from 2023 or later: " + error;
});
