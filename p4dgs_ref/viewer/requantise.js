// What every number of a file costs, and the file as it would be with coarser or broken ones.
//
// Prices are those of the coder's integer tables: their sum is a section's entropy, which the bytes
// in the file exceed by a few bytes of the coder's state. An estimate adds the same few bytes.
"use strict";

(function (exported) {
  const p4dgs = typeof module === "object" ? require("./p4dgs.js") : globalThis.p4dgs;
  const { roundHalfEven } = p4dgs;
  const UNITS = { mu: 1024, sigma: 16 }; // mu / q in 1/1024, log2(sigma / q) in 1/16

  // --- prices -----------------------------------------------------------------------------------
  /** The bits of a symbol: -log2 of its frequency, its low bits, and Elias's code of an escape. */
  function symbolBits(symbol, mu_units, sigma_units) {
    const { first, n, low, cum } = p4dgs.gaussianTable(mu_units, sigma_units);
    const block = Math.floor(symbol / 2 ** low) - first;
    if (block < 0 || block >= n) {
      const beyond = block < 0 ? -2 * block : 2 * (block - n) + 1;
      return 24 + low + 2 * Math.floor(Math.log2(beyond)) + 1;
    }
    const end = block === n - 1 ? 2 ** 24 - 1 : cum(block + 1);
    const start = block === 0 ? 0 : cum(block);
    return 24 - Math.log2(end - start) + low;
  }

  /** The bits of N flags that share one probability: Eq. (14). */
  function flagBits(flags) {
    const ones = flags.reduce((sum, flag) => sum + flag, 0);
    const counts = [ones, flags.length - ones].filter((count) => count > 0);
    return counts.reduce((sum, count) => sum + count * Math.log2(flags.length / count), 0);
  }

  /** Whether column `i` of anchor `a` is in the file: offsets of masked children are not. */
  function isCoded({ header, masks, groups }, a, i) {
    const child = Math.floor((i - groups[3].first) / 3);
    return child < 0 || masks[a * header.k + child] === 1;
  }

  /** The bits of every symbol of an anchor, 0 where nothing is coded, [columns]. */
  function bitsOfAnchor(model, a) {
    const { columns, symbols, mu_units, sigma_units } = model;
    return Float64Array.from({ length: columns }, (_, i) => {
      const at = a * columns + i;
      return isCoded(model, a, i) ? symbolBits(symbols[at], mu_units[at], sigma_units[at]) : 0;
    });
  }

  /** What every anchor pays for its position and its masks, the mean of all. */
  function shared({ header, bytes, masks }) {
    const A = header.anchors;
    return { position: (8 * (bytes.positions - 24)) / A, masks: flagBits(masks) / A };
  }

  /** The bits of every anchor: position, attributes and masks, [A]. */
  function anchorBits(model) {
    const { position, masks } = shared(model);
    return Float64Array.from({ length: model.header.anchors }, (_, a) =>
      bitsOfAnchor(model, a).reduce((sum, bits) => sum + bits, position + masks),
    );
  }

  // --- a coarser file ---------------------------------------------------------------------------
  const UNCHANGED = { coarser: 1, context: true, sign: null, weight: false, frequency: false };

  /** The model and the estimated bytes of each section, {model, bytes}.
   *
   *  `coarser` multiplies every step q. Without `context` there is neither the hash grid nor a
   *  context network: q = Q_0, and one mean and deviation for every column of attributes. `sign` is
   *  the number of a sign of the grid that is flipped: anchors that read it have other steps, means
   *  and deviations. `weight` and `frequency` break psi_d, see below. */
  function requantise(model, changes) {
    const how = { ...UNCHANGED, ...changes };
    const bytes = { ...model.bytes };
    if (!how.context) Object.assign(bytes, { hash_grid: 0, context_mlps: 0 });
    const coarse = how.sign === null ? { ...model } : flipped(model, how.sign);
    for (const group of model.groups) {
      const { values, before, after } = attributes(model, coarse, group, how);
      coarse[group.name] = values;
      const table = how.context ? 0 : 4 * group.width; // two numbers of 16 bits a column
      bytes[group.section] += Math.round((after - before) / 8) + table;
    }
    if (how.weight) coarse.networks = oneWeight(coarse);
    if (how.frequency) coarse.networks = oneFrequency(coarse);
    return { model: coarse, bytes };
  }

  /** The model with another sign in the grid, and the context that follows from it. */
  function flipped(model, sign) {
    const other = { ...model, signs: model.signs.map((v, i) => (i === sign ? 1 - v : v)) };
    return { ...other, ...p4dgs.codingContext(other) };
  }

  /** One group of attributes: its values [A, width], and its bits before and after the change. */
  function attributes(model, coarse, { name, width, first }, { coarser, context }) {
    const { header, columns, q, mu_units, sigma_units, symbols } = model;
    const g = model.groups.findIndex((group) => group.name === name);
    const values = new Float64Array(model[name].length);
    let [before, after] = [0, 0];
    for (let i = 0; i < width; i++) {
      const column = []; // [the place of a symbol in the file, the new symbol]
      for (let a = 0; a < header.anchors; a++) {
        const at = a * columns + first + i;
        if (!isCoded(model, a, first + i)) continue;
        const step = coarser * (context ? coarse.q[4 * a + g] : header.Q_0[g]);
        const symbol = roundHalfEven((symbols[at] * q[4 * a + g]) / step);
        values[a * width + i] = symbol * step;
        column.push([at, symbol]);
        before += symbolBits(symbols[at], mu_units[at], sigma_units[at]);
      }
      const common = context ? null : columnUnits(column.map(([, symbol]) => symbol));
      for (const [at, symbol] of column) {
        const own = [coarse.mu_units[at], coarse.sigma_units[at]];
        const units = common ?? coarserUnits(...own, coarser);
        after += symbolBits(symbol, ...units);
      }
    }
    return { values, before, after };
  }

  const deviationUnits = (log2) =>
    Math.min(Math.max(Math.round(UNITS.sigma * log2), -128), 319);

  /** mu / q and log2(sigma / q) in their units where q is `coarser` times as large. */
  function coarserUnits(mu_units, sigma_units, coarser) {
    const log2 = sigma_units / UNITS.sigma - Math.log2(coarser);
    return [Math.round(mu_units / coarser), deviationUnits(log2)];
  }

  /** The mean and the deviation of a column of symbols, in the same units. */
  function columnUnits(symbols) {
    const mean = symbols.reduce((sum, v) => sum + v, 0) / Math.max(symbols.length, 1);
    const square = symbols.reduce((sum, v) => sum + (v - mean) ** 2, 0);
    const deviation = Math.sqrt(square / Math.max(symbols.length, 1)) + 2 ** -8;
    const mu_units = Math.min(Math.max(UNITS.mu * mean, -(2 ** 34)), 2 ** 34);
    return [Math.round(mu_units), deviationUnits(Math.log2(deviation))];
  }

  // --- broken -----------------------------------------------------------------------------------
  /** The networks with one weight 16 times as large, as if a bit of its exponent were wrong: the
   *  largest of the first head of psi_d, or of the last layer of psi_c where nothing moves. */
  function oneWeight({ header, networks }) {
    const name = networks.psi_d.length ? "psi_d" : "psi_c";
    const layers = [...networks[name]];
    const place = name === "psi_d" ? header.deformation.length : layers.length - 1;
    const W = layers[place].W.slice();
    const largest = W.reduce((best, w, i) => (Math.abs(w) > Math.abs(W[best]) ? i : best), 0);
    W[largest] *= 16;
    layers[place] = { ...layers[place], W };
    return { ...networks, [name]: layers };
  }

  /** The networks with a psi_d that sees t itself and sin t, cos t. It gets the means over t of the
   *  other waves, which the bias of its first layer then holds. Heads without a layer before them
   *  read the waves, too. */
  function oneFrequency({ header: { L_x, L_t, deformation }, networks }) {
    const first = 3 * (1 + 2 * L_x) + 1;
    const psi_d = networks.psi_d.map((layer, i) => {
      if (i > 0 && deformation.length > 0) return layer;
      const [W, b] = [layer.W.slice(), layer.b.slice()];
      for (let j = 1; j < L_t; j++) {
        const means = [1 - Math.cos(2 ** j), Math.sin(2 ** j)].map((v) => v / 2 ** j);
        means.forEach((mean, wave) => {
          const row = (first + 2 * j + wave) * layer.J;
          for (let out = 0; out < layer.J; out++) {
            b[out] += mean * W[row + out];
            W[row + out] = 0;
          }
        });
      }
      return { ...layer, W, b };
    });
    return { ...networks, psi_d };
  }

  /** PSNR in dB between two pictures of numbers from 0 to 255; infinite where they are equal. */
  function psnr(picture, other) {
    let sum = 0;
    for (let i = 0; i < picture.length; i++) sum += (picture[i] - other[i]) ** 2;
    // The fourth byte of a pixel, its alpha, is always the same and counts for nothing.
    return -10 * Math.log10(sum / (0.75 * picture.length) / 255 ** 2);
  }

  Object.assign(exported, { symbolBits, bitsOfAnchor, anchorBits, shared, isCoded, requantise });
  Object.assign(exported, { psnr, UNCHANGED, UNITS });
})(typeof module === "object" ? module.exports : (globalThis.requantise = {}));
