// One anchor in words and numbers: how it is stored, and how it is drawn, beside the equations.
"use strict";

(function (exported) {
  const { p4dgs, draw, layers, requantise } = globalThis;

  const NAMES = { f_a: "feature f", s_a: "scale s", l_a: "offset scale l", O_a: "offset O" };
  const AXES = "xyz";
  const MOST_BARS = 64; // of a feature
  const MOST_INTEGERS = 30; // on each side of a mean
  const MOST_ROWS = 200;
  const MOST_CHILDREN = 32;

  // --- elements of the page ---------------------------------------------------------------------
  /** A new element with attributes and children, which are elements or texts. */
  function element(name, attributes = {}, ...children) {
    const made = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    made.append(...children);
    return made;
  }

  /** A table within a frame that scrolls where the window is narrow. */
  function table(caption, head, rows) {
    const cell = (scope) => (text, i) =>
      scope || i === 0 ? element("th", { scope: scope ?? "row" }, text) : element("td", {}, text);
    const row = (scope) => (cells) => element("tr", {}, ...cells.map(cell(scope)));
    return element(
      "div",
      { class: "scroll", tabindex: "0", role: "region", "aria-label": caption },
      element(
        "table",
        {},
        element("caption", {}, caption),
        element("thead", {}, row("col")(head)),
        element("tbody", {}, ...rows.map(row())),
      ),
    );
  }

  // --- numbers ----------------------------------------------------------------------------------
  /** A number with four digits that count. */
  function digits(v) {
    if (Number.isInteger(v) && Math.abs(v) < 1e6) return String(v);
    const size = Math.abs(v);
    return size >= 1e5 || size < 1e-4 ? v.toExponential(2) : String(Number(v.toPrecision(4)));
  }

  // --- pictures of an anchor --------------------------------------------------------------------
  /** Bars for numbers, up and down where some are negative; `marked` is the number of one of them.
   *  `ends` stand below the first and the last one. */
  function bars(values, said, ends, marked = -1) {
    const [high, low] = [Math.max(...values, 0), Math.max(...values.map((v) => -v), 0)];
    const columns = values.map((v, i) => {
      const bar = element("b", i === marked ? { class: "marked" } : {});
      const part = 100 / (high + low || 1);
      bar.style.height = `${part * Math.abs(v)}%`;
      bar.style.bottom = `${part * Math.min(low, low + v)}%`;
      return element("i", {}, bar);
    });
    const below = element("div", { class: "ends" }, ...ends.map((end) => element("span", {}, end)));
    const picture = element("div", { class: "bars", role: "img", "aria-label": said }, ...columns);
    return element("figure", {}, picture, below, element("small", {}, said));
  }

  /** The feature of anchor `a` as bars, and the colours of its children seen by `cameras`. */
  function look(model, a, cameras) {
    const { header, columns, symbols, q } = model;
    const { d, k } = header;
    const feature = Array.from(symbols.slice(a * columns, a * columns + Math.min(d, MOST_BARS)));
    const step = digits(q[4 * a]);
    const said = `The feature: the integers ${feature.join(" ")}, times the step ${step}`;
    const rows = (array, width) => array.slice(a * width, (a + 1) * width);
    const widths = { f_a: d, masks: k, O_a: 3 * k, x_a: 3, s_a: 3, l_a: 3 };
    const parts = Object.entries(widths).map(([name, width]) => [name, rows(model[name], width)]);
    const one = { header, networks: model.networks, ...Object.fromEntries(parts) };
    const seen = cameras.map((camera) => layers.kept(one, camera));
    const children = Array.from(seen[0].index.slice(0, MOST_CHILDREN), (_, n) => {
      const row = element("i");
      const colors = seen.map(({ color }) => draw.rgb(color.slice(3 * n, 3 * n + 3)));
      row.style.background = `linear-gradient(to right, ${colors.join(", ")})`;
      return row;
    });
    const walk = element("div", { class: "walk" }, ...children, element("div", { id: "walker" }));
    const told = `Colours of its ${children.length} children from all sides: 0° to 360°`;
    const figure = element("figure", {}, walk, element("small", {}, told));
    return [bars(feature, said, ["number 0", `number ${feature.length - 1}`]), figure];
  }

  /** The sharpest and the vaguest prediction of a number of anchor `a`, of those that fit in. */
  function guesses(model, a) {
    const { mu_units, sigma_units, symbols } = model;
    const all = columnsOf(model).filter(({ column }) => requantise.isCoded(model, a, column));
    const own = all.map(({ label, column }) => {
      const at = a * model.columns + column;
      const [mu, units, symbol] = [mu_units[at], sigma_units[at], symbols[at]];
      const [mean, sigma] = [mu / requantise.UNITS.mu, 2 ** (units / requantise.UNITS.sigma)];
      const reach = Math.ceil(Math.max(3 * sigma + 2, Math.abs(symbol - mean) + 1));
      const bits = (n) => requantise.symbolBits(n, mu, units);
      return { label, mean, sigma, reach, symbol, bits };
    });
    const fit = own.filter(({ reach }) => reach <= MOST_INTEGERS);
    fit.sort((one, other) => one.sigma - other.sigma);
    const ends = fit.length > 1 ? [fit[0], fit.at(-1)] : fit;
    return ends.map(({ label, mean, sigma, reach, symbol, bits }) => {
      const first = Math.round(mean) - reach;
      const values = Array.from({ length: 2 * reach + 1 }, (_, i) => 2 ** -bits(first + i));
      const said =
        `${label}: mean ${mean.toFixed(1)}, σ ${sigma.toFixed(1)} steps. ` +
        `The actual integer, ${symbol}, costs ${bits(symbol).toFixed(1)} bits.`;
      return bars(values, said, [String(first), String(first + 2 * reach)], symbol - first);
    });
  }

  const list = (values, from, count) =>
    `(${Array.from(values.slice(from, from + count), digits).join(", ")})`;

  // --- how it is stored -------------------------------------------------------------------------
  /** The columns of the attributes: [name, group, its number, column]. */
  function columnsOf({ groups }) {
    return groups.flatMap(({ name, width, first }, g) =>
      Array.from({ length: width }, (_, i) => {
        const which = name === "f_a" ? i : AXES[i % 3];
        const child = name === "O_a" ? ` of child ${Math.floor(i / 3)}` : "";
        return { label: `${NAMES[name]}, ${which}${child}`, g, column: first + i };
      }),
    );
  }

  function stored(model, a) {
    const { columns, q, mu_units, sigma_units, symbols } = model;
    const bits = requantise.bitsOfAnchor(model, a);
    const rows = columnsOf(model).map(({ label, g, column }) => {
      const [at, step] = [a * columns + column, q[4 * a + g]];
      if (!requantise.isCoded(model, a, column)) return [label, "masked", "", "", "", "", "0"];
      const mu = (mu_units[at] / requantise.UNITS.mu) * step;
      const sigma = 2 ** (sigma_units[at] / requantise.UNITS.sigma) * step;
      const numbers = [symbols[at], step, symbols[at] * step, mu, sigma].map(digits);
      return [label, ...numbers, bits[column].toFixed(2)];
    });
    const head = ["number", "symbol", "step q", "value = symbol · q", "μ", "σ", "bits"];
    const left = rows.length > MOST_ROWS ? ` (the first ${MOST_ROWS} of ${rows.length})` : "";
    return table(`Its numbers in the file${left}`, head, rows.slice(0, MOST_ROWS));
  }

  /** Bits of each part of an anchor, as a table with the equation that prices it. */
  function bill(model, a, total) {
    const bits = requantise.bitsOfAnchor(model, a);
    const { position, masks } = requantise.shared(model);
    const sum = (values) => values.reduce((all, v) => all + v, 0);
    const parts = model.groups.map(({ name, first, width }) => [
      NAMES[name],
      sum(bits.slice(first, first + width)),
      "Eq. (11): bits = −log₂(Φ((v + q/2 − μ)/σ) − Φ((v − q/2 − μ)/σ))",
    ]);
    const plain = "three coordinates of 16 bits, and the box; the mean of all anchors";
    parts.unshift(["position", position, plain]);
    parts.push(["masks", masks, "Eq. (14): −log₂ of how frequent each flag is; the mean"]);
    const all = sum(parts.map(([, size]) => size));
    parts.push(["all", all, `of ${total.toLocaleString("en")} bits of the file`]);
    const share = (size) => `${((100 * size) / total).toFixed(3)} %`;
    const rows = parts.map(([name, size, why]) => [name, size.toFixed(1), share(size), why]);
    return table("What it costs", ["part", "bits", "share of the file", "by"], rows);
  }

  // --- how it is drawn --------------------------------------------------------------------------
  /** The equations of the context with this anchor's numbers. */
  function context(model, a) {
    const { header, q } = model;
    const h = new Float64Array(header.F * header.grid.length);
    p4dgs.hashFeature(model, a, h);
    const units = Array.from(h, (v) => v / 2 ** 15);
    const steps = model.groups.map(({ name }, g) => `${NAMES[name]} ${digits(q[4 * a + g])}`);
    return [
      ["Eq. (9)", "h = H(x_a)", `${list(units, 0, 16)}${units.length > 16 ? " …" : ""}`],
      ["Eq. (8)", "q = Q₀ (1 + tanh ψ_q(h))", steps.join("; ")],
      ["Eq. (12)", "μ, σ = ψ_p(h)", "the columns μ and σ of the table below"],
      ["Eq. (10)", "f̂ = round(f / q) · q", "the columns symbol and value"],
    ];
  }

  /** The equations of the picture: of the anchor, then of each of its children. */
  function drawn(frame, a) {
    const { model, camera, t } = frame;
    const { delta_vc, d_vc } = p4dgs.view(
      model.x_a.slice(3 * a, 3 * a + 3),
      p4dgs.centreOf(camera),
    );
    const seen = `δ = ${digits(delta_vc[0])}, d = ${list(d_vc, 0, 3)}`;
    const place = list(model.x_a, 3 * a, 3);
    return [
      ["Q14", "x_a = lo + n (hi − lo) / 65535", `${place}, n = ${list(model.positions, 3 * a, 3)}`],
      ["Eq. (2)", "δ = |x_a − x_c|, d = (x_a − x_c) / δ", seen],
      ["", "time", digits(t)],
    ];
  }

  function children(frame, a) {
    const { model, camera, gaussians, moved } = frame;
    const { k, tau_alpha } = model.header;
    const all = layers.kept(model, camera);
    const row = (child) => {
      const n = all.index.indexOf(child);
      const name = `child ${child - a * k}`;
      if (n < 0) return [name, "0", "not in the file", "", "", "", "", ""];
      const kept = gaussians.index.indexOf(child);
      const alpha = digits(all.alpha[n]);
      const said = all.alpha[n] < tau_alpha ? `${alpha}, below τ_α = ${digits(tau_alpha)}` : alpha;
      const [x, s, color] = [all.x, all.s, all.color].map((array) => list(array, 3 * n, 3));
      if (kept < 0) return [name, "1", said, x, s, color, "", ""];
      const delta = [0, 1, 2].map((i) => moved.x_t[3 * kept + i] - all.x[3 * n + i]);
      return [name, "1", said, x, s, color, list(delta, 0, 3), list(moved.x_t, 3 * kept, 3)];
    };
    const head = ["child", "mask", "α = tanh ψ_α, Eq. (3)", "x = x_a + O_a l_a, Eq. (1)"];
    head.push("s = s_a sigmoid(ψ_s), Eq. (4)", "colour = sigmoid(ψ_c), Eq. (3′)");
    head.push("δx = ψ_d(E(x), E(t)), Eq. (5)", "x_t = x + δx, Eq. (6)");
    const count = Math.min(k, MOST_CHILDREN);
    const rows = Array.from({ length: count }, (_, child) => row(a * k + child));
    const left = k > count ? ` (the first ${count} of ${k})` : "";
    return table(`Its children, as this camera sees them now${left}`, head, rows);
  }

  /** All that the page says of anchor `a`, as elements. `total` is the file's size in bits. */
  function anchor(frame, a, total) {
    const { model } = frame;
    const head = ["equation", "formula", "for this anchor"];
    const rows = [...drawn(frame, a), ...context(model, a)];
    return [
      bill(model, a, total),
      table("Its place and its context", head, rows),
      children(frame, a),
      stored(model, a),
    ];
  }

  Object.assign(exported, { anchor, look, guesses, element, table });
})((globalThis.explain = {}));
