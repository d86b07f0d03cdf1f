// Figures and tables of the page: how one pixel adds up, what one number costs, one anchor in words
// and numbers, how files of other lambda compare.
"use strict";

(function (exported) {
  const { p4dgs, draw, layers, requantise } = globalThis;
  const { UNITS } = requantise;

  const NAMES = { f_a: "feature f", s_a: "scale s", l_a: "offset scale l", O_a: "offset O" };
  const AXES = "xyz";
  const MOST_BARS = 64; // of a feature
  const MOST_ROWS = 200;
  const MOST_CHILDREN = 32;
  const MOST_SPLATS = 16; // of a pixel
  const [WIDE, TALL] = [320, 150]; // of a figure

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
  /** A number with four significant digits. */
  function digits(v) {
    if (Number.isInteger(v) && Math.abs(v) < 1e6) return String(v);
    const size = Math.abs(v);
    return size >= 1e5 || size < 1e-4 ? v.toExponential(2) : String(Number(v.toPrecision(4)));
  }

  // --- bars and curves --------------------------------------------------------------------------
  /** Bars for numbers, up and down where some are negative. `ends` stand below the first and the
   *  last one, `classOf(i)` is the class of bar i; one of `full` is as high as the picture. */
  function bars(values, said, ends, classOf = () => "", full = 0) {
    const [high, low] = [Math.max(...values, full), Math.max(...values.map((v) => -v), 0)];
    const columns = values.map((v, i) => {
      const bar = element("b", { class: classOf(i) });
      const part = 100 / (high + low || 1);
      bar.style.height = `${part * Math.abs(v)}%`;
      bar.style.bottom = `${part * Math.min(low, low + v)}%`;
      return element("i", {}, bar);
    });
    const below = element("div", { class: "ends" }, ...ends.map((end) => element("span", {}, end)));
    const picture = element("div", { class: "bars", role: "img", "aria-label": said }, ...columns);
    return element("figure", {}, picture, below, element("small", {}, said));
  }

  /** A drawing of WIDE x TALL from the text of its elements. */
  function drawing(said, parts) {
    const figure = element("figure");
    const head = `<svg viewBox="0 0 ${WIDE} ${TALL}" role="img" aria-label="${said}">`;
    figure.innerHTML = `${head}${parts.join("")}</svg>`;
    return figure;
  }

  // --- one pixel --------------------------------------------------------------------------------
  /** How the splats at a pixel add up to its colour: those of the first `count` in `order`, from
   *  front to back, are painted. Only those that weigh the most have bars. */
  function pixel({ splats, model }, order, count, [u_0, v_0]) {
    const { mean2d, conic, alpha, color } = splats;
    let T = 1;
    const all = order.map((n, i) => {
      const [u, v] = [u_0 - mean2d[2 * n], v_0 - mean2d[2 * n + 1]];
      const E = (conic[3 * n] * u * u + conic[3 * n + 2] * v * v) / 2 + conic[3 * n + 1] * u * v;
      const one = { i, alpha: Math.min(alpha[n] * Math.exp(-E), 0.99), T };
      T *= 1 - one.alpha;
      return { ...one, weight: one.alpha * one.T, color: draw.rgb(color.slice(3 * n, 3 * n + 3)) };
    });
    const least = all.map(({ weight }) => weight).sort((a, b) => b - a)[MOST_SPLATS] ?? 0;
    const few = all.filter(({ weight }) => weight > Math.max(least, 0.002));
    const isPainted = ({ i }) => i < count;
    const classOf = (i) => (isPainted(few[i]) ? "" : "later");
    const row = (key, said) => bars(few.map((one) => one[key]), said, [], classOf, 1);
    const rest = all.filter(isPainted).reduce((left, one) => left - one.weight, 1);
    const part = ([weight, color]) =>
      element("i", { style: `flex-grow: ${weight}; background: ${color}` });
    const painted = few.filter(isPainted).map(({ weight, color }) => [weight, color]);
    const mix = [...painted, [rest, draw.rgb(model.header.background)]].map(part);
    const added = few.filter(isPainted).map(({ weight }) => weight.toFixed(2)).join(" + ") || "0";
    return [
      row("alpha", "α: how opaque each Gaussian is at this pixel, the nearest first"),
      row("T", "T: what those in front of it let through, the product of their 1 − α"),
      row("weight", `weight = α T: ${added}; the background gets ${rest.toFixed(2)}`),
      element("div", { class: "mix" }, ...mix),
      element("small", {}, "The pixel: their colours, each as wide as its weight"),
    ];
  }

  // --- one number -------------------------------------------------------------------------------
  /** Number `column` of anchor `a`: its value v in the file, and of a model, which may have another
   *  context, its mean, deviation and step. */
  function numberOf(file, model, a, column) {
    const at = a * model.columns + column;
    const g = model.groups.findLastIndex(({ first }) => first <= column);
    const q = model.q[4 * a + g];
    const mu = (model.mu_units[at] / UNITS.mu) * q;
    const sigma = 2 ** (model.sigma_units[at] / UNITS.sigma) * q;
    return { v: file.symbols[at] * file.q[4 * a + g], mu, sigma, q };
  }

  /** The bell of Eq. (12) and the bin of Eq. (11) that v is rounded into. The axis ends `reach` on
   *  each side of `middle`; the bell is always as high. The coder's own tables give the bits. */
  function bell({ v, mu, sigma, q }, { middle, reach }) {
    const symbol = p4dgs.roundHalfEven(v / q);
    const units = [(UNITS.mu * mu) / q, UNITS.sigma * Math.log2(sigma / q)].map(Math.round);
    const bits = requantise.symbolBits(symbol, ...units);
    const x = (value) => (WIDE / 2) * (1 + Math.min(Math.max((value - middle) / reach, -1), 1));
    const y = (value) => TALL - 20 - 110 * Math.exp(-(((value - mu) / sigma) ** 2) / 2);
    const [left, right] = [(symbol - 0.5) * q, (symbol + 0.5) * q];
    const path = (from, to) => {
      const points = Array.from({ length: 101 }, (_, i) => from + (i / 100) * (to - from));
      return points.map((value) => `${x(value).toFixed(1)},${y(value).toFixed(1)}`).join(" ");
    };
    const base = TALL - 20;
    const bin = `${x(left)},${base} ${path(left, right)} ${x(right)},${base}`;
    const share = 2 ** -bits;
    const said =
      `${digits(v)} becomes ${symbol} · q = ${digits(symbol * q)}. The bin holds ` +
      `${digits(100 * share)} % of the bell: ${bits.toFixed(2)} bits.`;
    const parts = [
      `<polygon points="${bin}" class="bin" />`,
      `<polyline points="${path(middle - reach, middle + reach)}" />`,
      `<path d="M0 ${base}H${WIDE}M${x(v)} ${base}v8M${x(mu)} ${base}V${y(mu)}" class="thin" />`,
      `<text x="${x(v)}" y="${TALL}">value</text>`,
      `<text x="${x(mu)}" y="${y(mu) - 5}">μ</text>`,
    ];
    return [drawing(said, parts), element("p", { class: "result" }, said)];
  }

  // --- files of other lambda --------------------------------------------------------------------
  /** Files {data, lambda_rate, psnr_db} in the order of lambda, as points over their bytes: those
   *  in the set `visited`, one of them marked. The axis begins at `fixed`, the networks alone. */
  function curve(files, visited, marked, fixed) {
    const most = Math.max(...files.map(({ data }) => data.length));
    const psnr = files.map(({ psnr_db }) => psnr_db);
    const [low, high] = [Math.min(...psnr), Math.max(...psnr)];
    const x = (bytes) => 10 + ((WIDE - 50) * (bytes - fixed)) / (most - fixed);
    const y = (value) => 25 + ((TALL - 60) * (high - value)) / (high - low || 1);
    const seen = files.filter((one) => visited.has(one));
    const places = seen.map(({ data, psnr_db }) => [x(data.length), y(psnr_db)]);
    const point = ([u, v], i) =>
      `<circle cx="${u}" cy="${v}" r="${seen[i] === marked ? 6 : 3}" />` +
      `<text x="${u + 9}" y="${v + 14}" class="right">λ = ${seen[i].lambda_rate}</text>`;
    const [base, below] = [TALL - 18, TALL - 4];
    const [first, last] = [fixed, most].map((bytes) => bytes.toLocaleString("en"));
    return drawing(`PSNR from ${low} to ${high} dB over bytes`, [
      `<path d="M${x(fixed)} 5V${base}H${WIDE}" class="thin" />`,
      `<text x="3" y="${below}" class="right">${first} bytes: networks</text>`,
      `<text x="${x(most)}" y="${below}">${last}</text>`,
      `<text x="16" y="12" class="right">PSNR, ${low.toFixed(1)} to ${high.toFixed(1)} dB</text>`,
      `<polyline points="${places.join(" ")}" />`,
      ...places.map(point),
    ]);
  }

  // --- pictures of an anchor --------------------------------------------------------------------
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
      const mu = (mu_units[at] / UNITS.mu) * step;
      const sigma = 2 ** (sigma_units[at] / UNITS.sigma) * step;
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
    const plain = "three coordinates of 16 bits, and the box; mean over all anchors";
    parts.unshift(["position", position, plain]);
    parts.push(["masks", masks, "Eq. (14): −log₂ of the frequency of each flag; the mean"]);
    const all = sum(parts.map(([, size]) => size));
    parts.push(["all", all, `of ${total.toLocaleString("en")} bits of the file`]);
    const share = (size) => `${((100 * size) / total).toFixed(3)} %`;
    const rows = parts.map(([name, size, why]) => [name, size.toFixed(1), share(size), why]);
    return table("What it costs", ["part", "bits", "share of the file", "by"], rows);
  }

  /** The four steps of anchor `a`. */
  const steps = ({ groups, q }, a) =>
    groups.map(({ name }, g) => `${NAMES[name]} ${digits(q[4 * a + g])}`).join("; ");

  /** A button for each sign that the anchor reads at a level, the nearest node first. */
  function signs(frame, flip) {
    const { F } = frame.model.header;
    return layers.nodesRead(frame).flatMap(({ at, share }, i) =>
      Array.from({ length: F }, (_, f) => {
        const title = `Node ${i + 1}, number ${f}: weight ${digits(share)}. Click to flip.`;
        const said = frame.model.signs[at + f] ? "+" : "−";
        const button = element("button", { title, "aria-label": `${said} ${title}` }, said);
        button.addEventListener("click", () => flip(at + f));
        return button;
      }),
    );
  }

  // --- how it is drawn --------------------------------------------------------------------------
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

  /** All that the page says about anchor `a`, as elements. `total` is the file's size in bits. */
  function anchor(frame, a, total) {
    const { model } = frame;
    return [bill(model, a, total), children(frame, a), stored(model, a)];
  }

  Object.assign(exported, { anchor, look, element, table, pixel, columnsOf, numberOf });
  Object.assign(exported, { bell, curve, signs, steps, digits });
})((globalThis.explain = {}));
