// A second implementation of P-4DGS: opens a .p4dgs file and draws it.
//
// Written from two pages alone: the file format (`python -m p4dgs_ref.codec` prints it) and the
// vectors' page (`p4dgs_ref/oracle/v1/README.md`). It has no packages and needs no build: a page
// includes it as a script (the functions are then fields of `p4dgs`), and node requires it.
//
//     const model = p4dgs.decode(bytes);                            // a Uint8Array
//     const picture = p4dgs.render(model, camera, t, { least: 5e-5 });  // height x width x 3
//
// A camera is {W, T, focal, center, size}: rotation (9 numbers) and translation from the world into
// the camera, focal lengths and principal point in pixels, and [width, height].
//
// Names are the paper's. Axes: A anchors, k children each, d feature width, N Gaussians, F hash
// features. Arrays are typed and flat, row by row; [A, k, 3] says how they are meant.
"use strict";

(function port(exported) {
  // --- small functions --------------------------------------------------------------------------
  const clip = (v, low, high) => Math.min(Math.max(v, low), high);
  const total = (values) => values.reduce((a, b) => a + b, 0);
  const largest = (values) => values.reduce((most, v) => Math.max(most, Math.abs(v)), 0);
  // v / 2^s, rounded to the nearest integer and ties up; v itself where s is 0.
  const shifted = (v, s) => Math.floor((v + Math.floor(2 ** s / 2)) / 2 ** s);
  // Between entries i and i + 1 of a table, r parts of `unit` behind the first.
  const between = (T, i, r, unit) => T[i] + Math.floor(((T[i + 1] - T[i]) * r) / unit);

  /** Rounded to the nearest integer, ties to even. Math.round alone rounds them up. */
  function roundHalfEven(v) {
    const up = Math.round(v);
    return Math.abs(v % 1) === 0.5 && up % 2 !== 0 ? up - 1 : up;
  }

  /** The least integer p with v < 2^p, and 0 for 0: of an integer, the number of its digits. */
  function exponent(v) {
    const words = new Uint32Array(Float64Array.of(v).buffer); // the double itself says it
    return v > 0 ? (words[1] >>> 20) - 1022 : 0;
  }

  /** CRC-32 of bytes: polynomial 0xEDB88320 (reflected), initial and final value ~0. */
  function crc32(bytes) {
    let crc = ~0;
    for (const byte of bytes) {
      crc ^= byte;
      for (let bit = 0; bit < 8; bit++) crc = (crc >>> 1) ^ (crc & 1 && 0xedb88320);
    }
    return ~crc >>> 0;
  }

  // --- the tables of integers, from their formulas ----------------------------------------------
  /** The normal distribution function: 1/2 + phi(z) (z + z^3 / 3 + z^5 / (3 5) + ...). */
  function normal(z) {
    let [sum, term] = [0, z];
    for (let n = 3; Math.abs(term) > 1e-18; n += 2) {
      sum += term;
      term *= (z * z) / n;
    }
    return 0.5 + (Math.exp((-z * z) / 2) / Math.sqrt(2 * Math.PI)) * sum;
  }

  // No entry is closer to a tie than 4e-6, so the last digits of Math.exp and log2 do not matter.
  const table = (length, value) => Float64Array.from({ length }, (_, i) => Math.round(value(i)));
  const PHI = table(769, (i) => 2 ** 24 * normal(i / 64 - 6));
  const EXP2 = table(16, (i) => 2 ** (16 - i / 16));
  const SIGMOID = table(641, (i) => 2 ** 24 / (1 + Math.exp(-2 * (i / 64 - 4))));
  const LOG2 = table(257, (i) => 2 ** 16 * Math.log2(1 + i / 256));

  // --- sections, and what is refused ------------------------------------------------------------
  /** A file that is refused: its section ("container" for the frame), the byte in it, the kind. */
  class Refused extends Error {
    constructor(section, offset, kind, said) {
      super(`${section}, byte ${offset}: ${said}`);
      Object.assign(this, { section, offset, kind });
    }
  }

  /** The bytes of a section, read in order from `at` on. Raw bits are the last that is read; `at`
   *  then stays where they begin, and that is where they are refused. */
  class Section {
    constructor(name, bytes = []) {
      Object.assign(this, { name, bytes, at: 0, bitsRead: 0 });
    }

    need(condition, said, at = this.at, kind = this.name === "header" ? "header" : "stream") {
      if (!condition) throw new Refused(this.name, at, kind, said);
    }

    needSize(size) {
      const at = Math.min(this.bytes.length, size);
      this.need(this.bytes.length === size, `expected ${size} bytes`, at, "length");
    }

    /** The next unsigned integer of `size` bytes, its lowest byte first. */
    integer(size, at = this.at) {
      this.need(at + size <= this.bytes.length, "the section ends early");
      this.at = at + size;
      let v = 0;
      for (let i = at + size - 1; i >= at; i--) v = 256 * v + this.bytes[i];
      return v;
    }

    /** The next raw bits as a number; every byte and number from its lowest bit on. */
    bits(count) {
      let v = 0;
      for (let i = 0; i < count; i++, this.bitsRead++) {
        const byte = this.at + (this.bitsRead >>> 3);
        this.need(byte < this.bytes.length, "the raw bits end early");
        v += ((this.bytes[byte] >> (this.bitsRead & 7)) & 1) * 2 ** i;
      }
      return v;
    }

    /** Elias's gamma code: b zeros, a one, the b low bits of the number. */
    gamma() {
      let b = 0;
      for (; this.bits(1) === 0; b++) this.need(b < 33, "a number of more than 34 bits");
      return 2 ** b + this.bits(b);
    }

    end() {
      const bytes = Math.ceil(this.bitsRead / 8);
      this.need(this.at + bytes === this.bytes.length, "bytes are left over");
      this.need(this.bits(8 * bytes - this.bitsRead) === 0, "an unused bit is set");
    }
  }

  // --- container: the frame of the file ---------------------------------------------------------
  const MAGIC = [0x89, 0x50, 0x34, 0x44, 0x0d, 0x0a, 0x1a, 0x0a];
  const SECTIONS = ["header", "positions", "features", "scales", "offset_scales", "offsets"];
  SECTIONS.push("masks", "hash_grid", "deformation_mlp", "anchor_mlps", "context_mlps");

  /** The sections of a file, {name: bytes}; all checksums are right. */
  function openContainer(bytes) {
    const frame = new Section("container", bytes);
    const size = bytes.length;
    frame.need(size >= 18, "expected at least 18 bytes", Math.min(size, 10), "length");
    frame.need(size <= 2 ** 29, "expected at most 2^29 bytes", 10, "length");
    frame.need(MAGIC.every((byte, i) => bytes[i] === byte), "not a .p4dgs file", 0, "magic");
    const [version, n] = bytes.subarray(8, 10);
    frame.need(version === 1, `version ${version}, expected 1`, 8, "version");
    frame.need(n <= SECTIONS.length, `${n} sections, expected at most 11`, 9, "table");
    const end = 18 + 9 * n;
    const right = frame.integer(4, 10) === size && end <= size;
    frame.need(right, "not the length of this file", 10, "length");
    const crc = crc32(bytes.subarray(0, end - 4));
    const same = crc === frame.integer(4, end - 4);
    frame.need(same, "the checksum of the table is wrong", end - 4, "checksum");
    const rows = readRows(frame, end - 4);
    const stored = end + total(rows.map((row) => row.length));
    frame.need(stored === size, `the sections end at byte ${stored} of ${size}`, 14, "length");
    const sections = {};
    let at = end;
    for (const { name, length, crc } of rows) {
      sections[name] = bytes.subarray(at, (at += length));
      const same = crc32(sections[name]) === crc;
      new Section(name).need(same, "the checksum is wrong", 0, "checksum");
    }
    return sections;
  }

  /** The rows of the table, which ends at a byte: name, length and checksum of each section. */
  function readRows(frame, end) {
    const rows = [];
    frame.at = 14;
    for (let last = 0; frame.at < end; ) {
      const id = frame.integer(1);
      const follows = last < id && id <= SECTIONS.length;
      frame.need(follows, `section ${id} after ${last}`, frame.at - 1, "table");
      rows.push({ name: SECTIONS[id - 1], length: frame.integer(4), crc: frame.integer(4) });
      last = id;
    }
    return rows;
  }

  // --- header: the design, and what it promises -------------------------------------------------
  const MOTION = ["translation", "scaling", "rotation"]; // in the order of the heads of psi_d
  const EFFECTS = [...MOTION, "view_color", "view_geometry", "occlusion", "background"];

  const whole = (low, high) => (v) => Number.isInteger(v) && low <= v && v <= high;
  const real = (low, high) => (v) => typeof v === "number" && low <= v && v <= high;
  const oneOf = (names) => (v) => names.includes(v);
  const list = (low, high, is) => (v) =>
    Array.isArray(v) && low <= v.length && v.length <= high && v.every((entry) => is(entry));
  const widths = list(0, 8, whole(1, 2 ** 14));
  const isLevel = (v) => oneOf(["xyz", "xy", "xz", "yz"])(v[0]) && whole(1, 2 ** 16)(v[1]);
  const level = (v) => Array.isArray(v) && v.length === 2 && isLevel(v);
  const distinct = (is) => (v) => is(v) && new Set(v).size === v.length;
  const FIELDS = {
    anchors: whole(1, 2 ** 22),
    background: list(3, 3, real(-(2 ** 20), 2 ** 20)),
    d: whole(1, 4096),
    k: whole(1, 256),
    hidden: widths,
    deformation: widths,
    L_x: whole(1, 64),
    L_t: whole(1, 64),
    context: widths,
    grid: list(1, 64, level),
    table: list(2, 2, whole(1, 2 ** 24)),
    F: whole(1, 64),
    Q_0: list(4, 4, real(2 ** -100, 2 ** 100)),
    tau_alpha: real(0, 1),
    effects: distinct(list(0, 7, oneOf(EFFECTS))),
  };
  const REAL = ["background", "Q_0", "tau_alpha"];
  const JSON_TOKEN = /"(?:[^"\\]|\\.)*"(\s*:)?|-?\d[\d.eE+-]*/g;

  /** The JSON object in a section. JSON.parse keeps the last of two equal keys and does not tell
   *  4.0 from 4. So the keys are counted, and {"real": 4.0} is read in the place of 4.0. */
  function parseHeader(section) {
    section.need(section.bytes.length <= 2 ** 14, "expected at most 2^14 bytes");
    section.need(section.bytes.every((byte) => byte < 128), "expected ASCII");
    let [keys, fields] = [0, null];
    const marked = String.fromCharCode(...section.bytes).replace(JSON_TOKEN, (token, colon) => {
      keys += colon ? 1 : 0;
      return token[0] !== '"' && /[.eE]/.test(token) ? `{"real": ${token}}` : token;
    });
    try {
      fields = JSON.parse(marked);
    } catch {
      // invalid JSON is not an object either
    }
    section.need(fields instanceof Object && !Array.isArray(fields), "expected a JSON object");
    section.need(keys === Object.keys(fields).length, "a field is repeated or nested");
    return fields;
  }

  /** The checked header. */
  function readHeader(section) {
    const header = parseHeader(section);
    const plain = (v) => (Array.isArray(v) ? v.map(plain) : (v?.real ?? v));
    for (const name of REAL) if (Object.hasOwn(header, name)) header[name] = plain(header[name]);
    for (const name of Object.keys(FIELDS)) {
      section.need(Object.hasOwn(header, name), `no field ${name}`);
    }
    for (const [name, value] of Object.entries(header)) {
      const right = Object.hasOwn(FIELDS, name) && FIELDS[name](value);
      section.need(right, `field ${name} is unknown or wrong`);
    }
    return header;
  }

  // The nodes of a level that are stored, and the entries of all levels.
  const nodesOf = ({ table }, [{ length: D }, R]) => Math.min(R ** D, table[D === 3 ? 0 : 1]);
  const entriesOf = (header) =>
    header.F * total(header.grid.map((level) => nodesOf(header, level)));

  /** Every network as a list of its layers [I, J], {psi_alpha: [[20, 32], ...], ...}. */
  function layersOf(header) {
    const { d, k, F, hidden, context, effects, deformation, L_x, L_t } = header;
    const chain = (...widths) => widths.slice(1).map((J, i) => [widths[i], J]);
    const view = (effect) => d + (effects.includes(effect) ? 4 : 0);
    const h = F * header.grid.length;
    const inputs = 3 * (1 + 2 * L_x) + 1 + 2 * L_t;
    const trunk = chain(inputs, ...deformation);
    const width = deformation.at(-1) ?? inputs;
    const heads = MOTION.filter((effect) => effects.includes(effect));
    const ends = heads.map((effect) => [width, effect === "rotation" ? 4 : 3]);
    return {
      psi_alpha: chain(view("view_geometry"), ...hidden, k),
      psi_c: chain(view("view_color"), ...hidden, 3 * k),
      psi_r: chain(view("view_geometry"), ...hidden, 4 * k),
      psi_s: chain(view("view_geometry"), ...hidden, 3 * k),
      psi_p: chain(h, ...context, 2 * (d + 6 + 3 * k)),
      psi_q: chain(h, ...context, 4),
      psi_d: heads.length ? [...trunk, ...ends] : [],
    };
  }

  /** Refuses a header that declares more numbers or work than a file of n bytes may. */
  function checkLimits(section, header, layers, n) {
    const { anchors, d, k, F, grid } = header;
    const entries = entriesOf(header);
    const weights = total(Object.values(layers).flat().map(([I, J]) => I * J + J));
    const numbers = anchors * (9 + d + 4 * k) + entries + weights;
    const reads = total(grid.map(([axes]) => 2 ** axes.length * 64 * (F + 8)));
    const context = total([...layers.psi_p, ...layers.psi_q].map(([I, J]) => I * J));
    section.need(entries <= 2 ** 24, `${entries} entries of the grid, expected at most 2^24`);
    section.need(numbers <= 2 ** 25, `${numbers} numbers, expected at most 2^25`);
    section.need(numbers <= 2 ** 22 + 16 * n, `${numbers} numbers in a file of ${n} bytes`);
    const work = anchors * (context + reads);
    section.need(work <= 2 ** 34 + 2 ** 15 * n, `${work} multiplications for ${n} bytes`);
  }

  // --- rANS: messages of entries from frequency tables ------------------------------------------
  // The state x < 2^63 of a lane is a pair of 32-bit numbers: x = hi 2^32 + lo.

  /** Takes a word from the stack where x < 2^31. */
  function refill(x, word) {
    if (x.hi > 0 || x.lo >= 2 ** 31) return;
    x.hi = x.lo;
    x.lo = word();
  }

  /** Takes b bits off a lane. */
  function popBits(x, b, word) {
    const v = x.lo % 2 ** b;
    x.lo = (x.hi % 2 ** b) * 2 ** (32 - b) + Math.floor(x.lo / 2 ** b);
    x.hi = Math.floor(x.hi / 2 ** b);
    refill(x, word);
    return v;
  }

  /** Takes the entry [start, start + freq) off a lane: x = floor(x / 2^24) freq + slot - start.
   *  x is below 2^63, so its quotient is taken in two parts, of which each product fits. */
  function pop(x, [start, freq], word) {
    const slot = x.lo & 0xffffff;
    const quotient = x.hi * 256 + (x.lo >>> 24);
    const high = Math.floor(quotient / 2 ** 24) * freq;
    const low = (quotient % 2 ** 24) * freq + slot - start + (high % 256) * 2 ** 24;
    x.hi = Math.floor(high / 256) + Math.floor(low / 2 ** 32);
    x.lo = low % 2 ** 32;
    refill(x, word);
  }

  /** Reads a message of n symbols: `take(i, slot)` is given the slot of symbol i and returns the
   *  entry that it lies in, [start, freq]. */
  function readMessage(section, n, take) {
    if (n === 0) return;
    const begin = section.at;
    const first = section.integer(1);
    const L = 2 ** (first & 15);
    section.need(L <= 1024 && (first & 0x70) === 0, "expected at most 2^10 lanes", begin);
    const tail = L > 1 ? section.integer(4) : n;
    const fits = tail <= n && (n - tail) % L === 0 && tail > 0;
    section.need(fits, `a tail of ${tail} of ${n} symbols in ${L} lanes`, begin + 1);
    const state = section.at;
    const zero = { lo: section.integer(4), hi: first & 128 ? section.integer(4) : 0 };
    const possible = first & 128 ? 0 < zero.hi && zero.hi < 2 ** 31 : zero.lo >= 2 ** 31;
    section.need(possible, "an impossible state", state);
    const given = []; // what ended lanes put on the stack
    const word = () => given.pop() ?? section.integer(4);
    const lanes = [zero];
    while (lanes.length < L) {
      const digits = popBits(zero, 5, word);
      const high = 2 ** digits + popBits(zero, digits, word);
      const low = (high % 2) * 2 ** 31 + popBits(zero, 31, word);
      lanes.push({ hi: Math.floor(high / 2), lo: low });
    }
    for (let i = 0; i < n; i++) {
      while (i === n - tail && lanes.length > 1) {
        const last = lanes.pop();
        section.need(last.hi === 0 && last.lo >= 2 ** 31, "a lane does not end as it started");
        endLane(last, zero, given);
      }
      const x = lanes[i % lanes.length];
      pop(x, take(i, x.lo & 0xffffff), word);
    }
    const ended = zero.hi === 0 && zero.lo === 2 ** 31 && given.length === 0;
    section.need(ended, "the message does not end where it began");
  }

  /** Lane x ends: its 31 low bits go back to lane 0, of whose words the low one may be too many. */
  function endLane(x, zero, given) {
    if (zero.hi > 0) given.push(zero.lo);
    const rest = zero.hi > 0 ? zero.hi : zero.lo;
    zero.hi = Math.floor(rest / 2);
    zero.lo = (rest % 2) * 2 ** 31 + (x.lo - 2 ** 31);
  }

  // --- streams ----------------------------------------------------------------------------------
  /** The frequency table of a Gaussian: n blocks from `first` = c - W on, each with `low` bits, and
   *  cum(j), its distribution function at the lower boundary of block first + j, plus j. */
  function gaussianTable(mu_units, sigma_units) {
    const e = Math.floor(sigma_units / 16);
    const step = Math.max(e + 6, 0);
    const mean = shifted(mu_units, step) * 2 ** step;
    const low = Math.max(e - 4, 0);
    const unit = 2 ** (10 + low);
    const W = 1 + Math.ceil(12 * 2 ** Math.min(e, 4));
    const first = Math.floor((mean + 512) / unit) - W;
    const n = 2 * W + 1;
    const slope = EXP2[sigma_units - 16 * e] / 2 ** (12 + e);
    const cum = (j) => {
      const z = clip(Math.floor(((first + j) * unit - 512 - mean) * slope), -98304, 98303);
      const C = between(PHI, Math.floor(z / 256) + 384, z & 255, 256);
      return Math.floor((C * (2 ** 24 - n - 1)) / 2 ** 24) + j;
    };
    return { first, n, low, cum };
  }

  /** The block that a slot lies in, counted from c - W on (n for the escape), and its entry. */
  function findBlock({ n, cum }, slot) {
    let [low, high, start, end] = [0, n, 0, 2 ** 24 - 1];
    if (slot === end) return [n, [end, 1]];
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      const at = cum(middle);
      if (at <= slot) [low, start] = [middle, at];
      else [high, end] = [middle, at];
    }
    return [low, [start, end - start]];
  }

  /** A Gaussian stream, which fills a section to its end: its symbols. */
  function readGaussians(section, mu_units, sigma_units) {
    const n = mu_units.length;
    const symbols = new Float64Array(n); // at first their blocks
    const low = new Uint8Array(n);
    const escapes = [];
    readMessage(section, n, (i, slot) => {
      const table = gaussianTable(mu_units[i], sigma_units[i]);
      const [block, entry] = findBlock(table, slot);
      symbols[i] = table.first + block;
      low[i] = table.low;
      if (block === table.n) escapes.push([i, table.first]);
      return entry;
    });
    const rest = Uint16Array.from(low, (count) => section.bits(count));
    for (const [i, first] of escapes) {
      const v = section.gamma();
      symbols[i] = v % 2 ? symbols[i] + (v - 1) / 2 : first - v / 2;
    }
    for (let i = 0; i < n; i++) symbols[i] = symbols[i] * 2 ** low[i] + rest[i];
    section.need(largest(symbols) <= 2 ** 31, "a symbol beyond 2^31");
    section.end();
    return symbols;
  }

  /** A bit stream, which fills a section: n bits that share the probability f / 2^24 of a one. */
  function readBits(section, n) {
    const bits = new Uint8Array(n);
    const f = n ? section.integer(4) : 0;
    const zeros = 2 ** 24 - f;
    section.need(zeros >= 0, "a probability above 1", 0);
    const certain = f === 0 || zeros === 0;
    if (certain) bits.fill(zeros ? 0 : 1);
    readMessage(section, certain ? 0 : n, (i, slot) => {
      bits[i] = slot >= zeros ? 1 : 0;
      return bits[i] ? [zeros, f] : [0, zeros];
    });
    section.end();
    return bits;
  }

  // --- positions --------------------------------------------------------------------------------
  /** The box {lo, hi}, the positions in it, 16 bits per coordinate, and x_a, [A, 3] each. */
  function readPositions(section, { anchors }) {
    const { bytes } = section;
    section.needSize(24 + 6 * anchors);
    const view = new DataView(bytes.buffer, bytes.byteOffset, 24);
    const [lo, hi] = [0, 12].map((at) => [0, 4, 8].map((i) => view.getFloat32(at + i, true)));
    const right = lo.every((v, i) => -1e30 <= v && v <= hi[i] && hi[i] <= 1e30);
    section.need(right, `the box from ${lo} to ${hi}`, 0, "number");
    section.at = 24;
    const positions = Uint16Array.from({ length: 3 * anchors }, () => section.integer(2));
    const step = (i) => (hi[i] - lo[i]) / 65535;
    const x_a = Float64Array.from(positions, (n, i) => lo[i % 3] + n * step(i % 3));
    return { lo, hi, positions, x_a };
  }

  // --- networks ---------------------------------------------------------------------------------
  const NETWORKS = {
    anchor_mlps: ["psi_alpha", "psi_c", "psi_r", "psi_s"],
    context_mlps: ["psi_p", "psi_q"],
    deformation_mlp: ["psi_d"],
  };

  /** All networks, {name: [{I, J, W, b}, ...]}; those of no layers have no numbers in the file. */
  function readNetworks(sections, shapes) {
    const networks = {};
    for (const [section, names] of Object.entries(NETWORKS)) {
      const layers = names.flatMap((name) => shapes[name]);
      const numbers = layers.length ? readFloat16(sections[section], layers) : [];
      let at = 0;
      const take = (length) => numbers.subarray(at, (at += length));
      const layer = ([I, J]) => ({ I, J, W: take(I * J), b: take(J) });
      for (const name of names) networks[name] = shapes[name].map(layer);
    }
    return networks;
  }

  /** Numbers of 16 bits, of which 10 are the fraction and 5 the exponent. */
  function readFloat16(section, layers) {
    const count = total(layers.map(([I, J]) => I * J + J));
    section.needSize(2 * count);
    return Float64Array.from({ length: count }, () => {
      const bits = section.integer(2);
      const [e, m] = [(bits >> 10) & 31, bits & 1023];
      section.need(e < 31, "a weight that is not finite", section.at - 2, "number");
      const size = e ? (1024 + m) * 2 ** (e - 25) : m * 2 ** -24;
      return bits & 0x8000 ? -size : size;
    });
  }

  /** y = x W + b for `rows` rows, and ReLU(y) where the layer is hidden. */
  function linear({ I, J, W, b }, x, rows, hidden) {
    const y = new Float64Array(rows * J);
    for (let row = 0; row < rows; row++) {
      const [from, to] = [row * I, row * J];
      for (let j = 0; j < J; j++) y[to + j] = b[j];
      for (let i = 0; i < I; i++) {
        const v = x[from + i];
        if (v === 0) continue; // a ReLU leaves many zeros
        for (let j = 0, w = i * J; j < J; j++, w++) y[to + j] += v * W[w];
      }
      if (hidden) for (let j = to; j < to + J; j++) if (y[j] < 0) y[j] = 0;
    }
    return y;
  }

  /** y = W_n relu(... relu(x W_0 + b_0) ...) + b_n; in integers a hidden layer drops s bits. */
  function mlp(layers, x, rows) {
    layers.forEach((layer, i) => {
      x = linear(layer, x, rows, i < layers.length - 1);
      if (layer.s) x = x.map((y) => shifted(y, layer.s));
    });
    return x;
  }

  // --- the coding context, in integers ----------------------------------------------------------
  /** A network in integers: weights W' = W 2^n, biases b' = b 2^(a + n). Its outputs have a
   *  fractional bits and are at most B. */
  function integerNetwork(network) {
    let [a, X, B] = [15, 2 ** 15, 0];
    const layers = network.map(({ I, J, W, b }, i) => {
      const n = Math.min(15 - exponent(largest(W)), 50 - exponent(largest(b)) - a, 24);
      const W_n = W.map((w) => roundHalfEven(w * 2 ** n));
      const b_n = b.map((w) => roundHalfEven(w * 2 ** (a + n)));
      const sums = new Float64Array(J);
      W_n.forEach((w, at) => (sums[at % J] += Math.abs(w)));
      B = X * largest(sums) + largest(b_n);
      const s = i < network.length - 1 ? Math.max(0, exponent(B) - 22) : 0;
      X = shifted(B, s);
      a += n - s;
      return { I, J, W: W_n, b: b_n, s };
    });
    return { layers, a, t: Math.max(0, exponent(B) - 28) };
  }

  // An output y in units of 2^-a, in units of 2^-c.
  const inUnits = (y, a, c) => (a > c ? shifted(y, a - c) : y * 2 ** (c - a));

  /** The row of a node: i + j R + k R^2, or where the table is too small, the hash of Q11. */
  function hashRow(node, R, T) {
    const [i, j, k = 0] = node;
    if (R ** node.length <= T) return i + j * R + k * R * R;
    return ((i ^ Math.imul(j, 2654435761) ^ Math.imul(k, 805459861)) >>> 0) % T;
  }

  /** Eq. (9): h = H(x_a), in units of 2^-15. `signs` holds 1 for +1 and 0 for -1. */
  function hashFeature({ header, positions, signs }, anchor, h) {
    const F = header.F;
    let [first, out] = [0, 0];
    for (const [axes, R] of header.grid) {
      const T = nodesOf(header, [axes, R]);
      const n = [...axes].map((axis) => positions[3 * anchor + "xyz".indexOf(axis)] * (R - 1));
      const base = n.map((v) => Math.floor(v / 65535));
      const sums = new Float64Array(F);
      for (let corner = 0; corner < 2 ** n.length; corner++) {
        let weight = 1;
        const node = base.map((b, i) => {
          const [upper, t] = [(corner >> i) & 1, n[i] - 65535 * b];
          weight *= upper ? t : 65535 - t;
          return Math.min(b + upper, R - 1);
        });
        const at = first + hashRow(node, R, T) * F;
        for (let f = 0; f < F; f++) sums[f] += signs[at + f] ? weight : -weight;
      }
      const Q = Math.floor(65535 ** n.length / 2 ** 15);
      for (const v of sums) h[out++] = Math.floor((v + Math.floor(Q / 2)) / Q);
      first += T * F;
    }
    return h;
  }

  /** Eq. (8): q = Q_0 (1 + tanh(psi_q(h))), as q_units of Q_0 2^-15. */
  function stepUnits(y, a) {
    const u = clip(inUnits(y, a, 12), -(2 ** 15), 2 ** 15);
    const v = clip(u + 4 * 2 ** 12, 0, 10 * 2 ** 12 - 1);
    const share = between(SIGMOID, Math.floor(v / 64), v % 64, 64);
    return clip(shifted(share, 8), 32, 65536);
  }

  /** What means and deviations need of a step: Q_0 = f 2^p, and of D = f q_units its digits n, its
   *  logarithm, and R, about 1 / D. */
  function reciprocal(Q_0, q_units) {
    const p = exponent(Q_0);
    const D = Math.floor(2 ** 24 * (Q_0 / 2 ** p)) * q_units;
    const n = exponent(D) - 24;
    const top = Math.floor(D / 2 ** n);
    const i = Math.floor((top - 2 ** 23) / 2 ** 15);
    const log2_D = (n + 23) * 2 ** 16 + between(LOG2, i, top % 2 ** 15, 2 ** 15);
    return { p, n, log2_D, R: Math.floor(2 ** 47 / top) };
  }

  /** Eq. (12), the mean: mu / q in units of 1/1024. */
  function meanUnits(y, { a, t }, { p, n, R }) {
    const S = a - t + p + n - 2;
    return clip(Math.floor(shifted(y, t) * R * 2 ** -S + 0.5), -(2 ** 34), 2 ** 34);
  }

  /** Eq. (12), the deviation: log2(sigma / q) in units of 1/16. */
  function deviationUnits(y, { a }, { p, log2_D }) {
    const raw = clip(inUnits(y, a, 16), -14 * 2 ** 16, 6 * 2 ** 16);
    const log2_sigma = shifted(94548 * raw, 16);
    return clip(shifted(log2_sigma - log2_D - (p - 39) * 2 ** 16, 12), -128, 319);
  }

  /** The context of all anchors: q_units and q [A, 4], mu_units and sigma_units [A, columns]. */
  function codingContext(model) {
    const { header, networks, groups, columns } = model;
    const A = header.anchors;
    const [psi_p, psi_q] = [networks.psi_p, networks.psi_q].map(integerNetwork);
    const h = new Float64Array(header.F * header.grid.length);
    const q_units = new Int32Array(4 * A);
    const mu_units = new Float64Array(A * columns);
    const sigma_units = new Int16Array(A * columns);
    for (let a = 0; a < A; a++) {
      hashFeature(model, a, h);
      const [u, y] = [mlp(psi_q.layers, h, 1), mlp(psi_p.layers, h, 1)];
      groups.forEach(({ width, first }, g) => {
        q_units[4 * a + g] = stepUnits(u[g], psi_q.a);
        const step = reciprocal(header.Q_0[g], q_units[4 * a + g]);
        for (let i = 0; i < width; i++) {
          const at = a * columns + first + i;
          mu_units[at] = meanUnits(y[2 * first + i], psi_p, step);
          sigma_units[at] = deviationUnits(y[2 * first + width + i], psi_p, step);
        }
      });
    }
    const q = Float64Array.from(q_units, (units, i) => units * (header.Q_0[i % 4] * 2 ** -15));
    return { q_units, q, mu_units, sigma_units };
  }

  // --- a file -----------------------------------------------------------------------------------
  /** The model in a file. Throws Refused. */
  function decode(bytes) {
    const found = openContainer(bytes);
    const sections = {};
    for (const name of SECTIONS) sections[name] = new Section(name, found[name]);
    sections.header.need(found.header, "the section is missing", 0, "missing");
    const header = readHeader(sections.header);
    const shapes = layersOf(header);
    const sizes = Object.entries(found).map(([name, body]) => [name, body.length]);
    checkLimits(sections.header, header, shapes, total(sizes.map(([, size]) => size)));
    for (const [name, section] of Object.entries(sections)) {
      const asked = name !== "deformation_mlp" || shapes.psi_d.length > 0;
      section.need(found[name] || !asked, "the section is missing", 0, "missing");
      section.need(!found[name] || asked, "no effect needs this section", 0, "unexpected");
    }
    const { anchors: A, d, k } = header;
    const groups = [
      { name: "f_a", section: "features", width: d, first: 0 },
      { name: "s_a", section: "scales", width: 3, first: d },
      { name: "l_a", section: "offset_scales", width: 3, first: d + 3 },
      { name: "O_a", section: "offsets", width: 3 * k, first: d + 6 },
    ];
    const columns = d + 6 + 3 * k;
    const model = { header, groups, columns, bytes: Object.fromEntries(sizes) };
    Object.assign(model, readPositions(sections.positions, header));
    model.networks = readNetworks(sections, shapes);
    model.signs = readBits(sections.hash_grid, entriesOf(header));
    model.masks = readBits(sections.masks, A * k);
    Object.assign(model, codingContext(model));
    model.symbols = new Float64Array(A * columns);
    groups.forEach((group, g) => {
      model[group.name] = readAttributes(model, group, g, sections[group.section]);
    });
    return model;
  }

  /** Eq. (10) backwards: f = symbol q, for group g of the attributes; masked offsets are 0. */
  function readAttributes(model, { name, width, first }, g, section) {
    const { masks, mu_units, sigma_units, symbols, columns, q } = model;
    const all = Int32Array.from({ length: (q.length / 4) * width }, (_, i) => i);
    const column = (i) => Math.floor(i / width) * columns + first + (i % width);
    const coded = all.filter((i) => name !== "O_a" || masks[Math.floor(i / 3)]).map(column);
    const mu = Float64Array.from(coded, (at) => mu_units[at]);
    const found = readGaussians(section, mu, coded.map((at) => sigma_units[at]));
    coded.forEach((at, n) => (symbols[at] = found[n]));
    return Float64Array.from(all, (i) => symbols[column(i)] * q[4 * Math.floor(i / width) + g]);
  }

  // --- spatial prediction: from anchors to canonical Gaussians ----------------------------------
  /** 1 / (1 + exp(-y)), without overflow. */
  function sigmoid(y) {
    const e = Math.exp(-Math.abs(y));
    return (y < 0 ? e : 1) / (1 + e);
  }

  /** Quaternions, [N, 4]: r / sqrt(|r|^2 + 1e-24), without squares that overflow. */
  function unit(r) {
    const unit = new Float64Array(r.length);
    for (let i = 0; i < r.length; i += 4) {
      const length = Math.hypot(r[i], r[i + 1], r[i + 2], r[i + 3], 1e-12);
      for (let j = i; j < i + 4; j++) unit[j] = r[j] / length;
    }
    return unit;
  }

  /** Arrays of `rows` rows side by side; `parts` are pairs [array, width]. One row is repeated. */
  function beside(rows, ...parts) {
    const width = total(parts.map(([, w]) => w));
    const all = new Float64Array(rows * width);
    let first = 0;
    for (const [array, w] of parts) {
      for (let i = 0; i < rows * w; i++) {
        all[Math.floor(i / w) * width + first + (i % w)] = array[i % array.length];
      }
      first += w;
    }
    return all;
  }

  /** Rows of an array [rows, width] by their numbers. */
  function gather(array, index, width) {
    const rows = new Float64Array(index.length * width);
    index.forEach((row, n) => rows.set(array.subarray(row * width, (row + 1) * width), n * width));
    return rows;
  }

  // Of an array [A, 3], what belongs to number i of an array [A, k, 3].
  const ofAnchor = (array, i, { length }) =>
    array[3 * Math.floor((i * array.length) / (3 * length)) + (i % 3)];

  /** Eq. (1): x = x_a + O_a * l_a, for every child, [A, k, 3]. */
  const offsets = (x_a, O_a, l_a) =>
    O_a.map((O, i) => ofAnchor(x_a, i, O_a) + O * ofAnchor(l_a, i, O_a));

  /** Eq. (2): delta_vc = |x_a - x_c|, d_vc = (x_a - x_c) / delta_vc, zeros at distance 0. */
  function view(x_a, x_c) {
    const away = x_a.map((x, i) => x - x_c[i % 3]);
    const length = (a) => Math.hypot(away[3 * a], away[3 * a + 1], away[3 * a + 2]);
    const delta_vc = Float64Array.from({ length: x_a.length / 3 }, (_, a) => length(a));
    return { delta_vc, d_vc: away.map((v, i) => v / (delta_vc[Math.floor(i / 3)] || 1)) };
  }

  /** Eq. (3): alpha = tanh(psi_alpha(f_a, delta_vc, d_vc)), [A, k]. `inputs` are those three. */
  const opacity = (psi_alpha, inputs, A) => mlp(psi_alpha, inputs, A).map(Math.tanh);
  /** Eq. (3'): color = sigmoid(psi_c(f_a, delta_vc, d_vc)), [A, k, 3]. */
  const color = (psi_c, inputs, A) => mlp(psi_c, inputs, A).map(sigmoid);
  /** Eq. (3'): r = psi_r(f_a, delta_vc, d_vc) / |psi_r(...)|, [A, k, 4]. */
  const rotation = (psi_r, inputs, A) => unit(mlp(psi_r, inputs, A));
  /** Eq. (4): s = s_a * sigmoid(psi_s(f_a, delta_vc, d_vc)), [A, k, 3]. */
  const scale = (psi_s, s_a, inputs, A) =>
    mlp(psi_s, inputs, A).map((y, i, all) => ofAnchor(s_a, i, all) * sigmoid(y));
  /** Children that are drawn: those with mask 1 and alpha >= tau_alpha, as a k + child. */
  const masking = (alpha, masks, tau_alpha) =>
    Int32Array.from(alpha.keys()).filter((i) => masks[i] && alpha[i] >= tau_alpha);

  /** The canonical Gaussians that a camera at x_c sees: x, s, r, alpha, color, and their index. */
  function spatialPrediction({ header, networks, x_a, f_a, s_a, l_a, O_a, masks }, x_c) {
    const A = x_a.length / 3;
    const { delta_vc, d_vc } = view(x_a, x_c);
    const seen = beside(A, [f_a, f_a.length / A], [delta_vc, 1], [d_vc, 3]);
    const inputs = (effect) => (header.effects.includes(effect) ? seen : f_a);
    const geometry = inputs("view_geometry");
    const alpha = opacity(networks.psi_alpha, geometry, A);
    const index = masking(alpha, masks, header.tau_alpha);
    return {
      x: gather(offsets(x_a, O_a, l_a), index, 3),
      s: gather(scale(networks.psi_s, s_a, geometry, A), index, 3),
      r: gather(rotation(networks.psi_r, geometry, A), index, 4),
      alpha: gather(alpha, index, 1),
      color: gather(color(networks.psi_c, inputs("view_color"), A), index, 3),
      index,
    };
  }

  // --- temporal prediction: from canonical Gaussians to those at t ------------------------------
  /** E(p) = (p, sin 2^j p, cos 2^j p), j = 0 ... L-1, for rows of D coordinates. */
  function positionalEncoding(p, D, L) {
    const width = D * (1 + 2 * L);
    const E = new Float64Array((p.length / D) * width);
    for (let i = 0; i < p.length; i++) {
      const at = Math.floor(i / D) * width + (i % D);
      E[at] = p[i];
      for (let j = 0; j < L; j++) {
        E[at + D * (1 + 2 * j)] = Math.sin(2 ** j * p[i]);
        E[at + D * (2 + 2 * j)] = Math.cos(2 ** j * p[i]);
      }
    }
    return E;
  }

  /** Eq. (5): (delta_x, delta_s, delta_r) = psi_d(concat(E(x), E(t))), a list, one per head.
   *  The last `heads` layers of psi_d stand side by side. */
  function deformation(psi_d, heads, x, t, { L_x, L_t }) {
    const N = x.length / 3;
    const E_t = positionalEncoding([t], 1, L_t);
    const E_x = [positionalEncoding(x, 3, L_x), 3 * (1 + 2 * L_x)];
    const trunk = psi_d.slice(0, psi_d.length - heads);
    let h = beside(N, E_x, [E_t, E_t.length]);
    for (const layer of trunk) h = linear(layer, h, N, true);
    return psi_d.slice(trunk.length).map((head) => linear(head, h, N, false));
  }

  /** Eq. (6): x_t = x + delta_x, s_t = s + delta_s, r_t = unit(r + delta_r). What has no delta
   *  stays as it is. */
  function deformed({ x, s, r }, { translation, scaling, rotation }) {
    const plus = (a, delta) => (delta ? a.map((v, i) => v + delta[i]) : a);
    const r_t = rotation ? unit(plus(r, rotation)) : r;
    return { x_t: plus(x, translation), s_t: plus(s, scaling), r_t };
  }

  /** The Gaussians at time t: x_t, s_t, r_t. */
  function temporalPrediction({ header, networks }, gaussians, t) {
    const heads = MOTION.filter((effect) => header.effects.includes(effect));
    if (heads.length === 0) return deformed(gaussians, {});
    const deltas = deformation(networks.psi_d, heads.length, gaussians.x, t, header);
    return deformed(gaussians, Object.fromEntries(heads.map((name, i) => [name, deltas[i]])));
  }

  // --- splats -----------------------------------------------------------------------------------
  /** The rotation of a unit quaternion r = (w, x, y, z), row by row. */
  function rotationMatrix(w, x, y, z) {
    return [
      [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ];
  }

  /** Products of vectors: of three numbers of `b` from number i on, and of `a` from number j on. */
  const dot = (a, b, i = 0, j = 0) => a[j] * b[i] + a[j + 1] * b[i + 1] + a[j + 2] * b[i + 2];
  const square = (a) => dot(a, a);
  const cross = ([a, b, c], [d, e, f]) => [b * f - c * e, c * d - a * f, a * e - b * d];

  /** M = R(r) diag(s), a root of Sigma = M M^T, [N, 3, 3]. */
  function root(s, r) {
    const M = new Float64Array(3 * s.length);
    for (let n = 0; n < s.length / 3; n++) {
      const R = rotationMatrix(r[4 * n], r[4 * n + 1], r[4 * n + 2], r[4 * n + 3]);
      for (let i = 0; i < 9; i++) M[9 * n + i] = R[Math.floor(i / 3)][i % 3] * s[3 * n + (i % 3)];
    }
    return M;
  }

  /** Sigma = R(r) diag(s)^2 R(r)^T, [N, 3, 3]. */
  function covariance(s, r) {
    const M = root(s, r);
    return M.map((_, at) => {
      const [row, column] = [at - (at % 3), at - (at % 9) + 3 * (at % 3)];
      return dot(M.subarray(row, row + 3), M, column);
    });
  }

  /** Sigma_2D = J W Sigma W^T J^T + 0.3 I, its inverse `conic`, both as (a, b, c); mean2d, depth.
   *  What is not visible has zeros everywhere.
   *
   *  Of `Sigma` or of a root M, Sigma = M M^T, with which the determinant of no needle cancels. */
  function projection(x, { Sigma, M }, { W, T, focal, center, size }) {
    const N = x.length / 3;
    const [mean2d, depth] = [new Float64Array(2 * N), new Float64Array(N)];
    const [cov2d, conic] = [new Float64Array(3 * N), new Float64Array(3 * N)];
    const visible = new Uint8Array(N);
    const right = M ?? Sigma;
    const limit = [0, 1].map((row) => (1.3 * size[row]) / (2 * focal[row]));
    const [place, V, product] = [[0, 0, 0], [[0, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 0, 0]]];
    const [u, v] = product;
    const left = M ? product : V;
    for (let n = 0; n < N; n++) {
      for (let i = 0; i < 3; i++) place[i] = dot(x, W, 3 * i, 3 * n) + T[i];
      const [X, Y, z] = place;
      if (!(z > 0.2) || !Number.isFinite(X + Y + z)) continue;
      for (let row = 0; row < 2; row++) {
        // V = J W: its rows are f / z (W_row - g W_z) with g = X / z, clipped to 1.3 half pictures.
        const g = clip(place[row] / z, -limit[row], limit[row]);
        for (let i = 0; i < 3; i++) V[row][i] = (focal[row] / z) * (W[3 * row + i] - g * W[6 + i]);
        const [V_x, V_y, V_z] = V[row];
        for (let j = 0, at = 9 * n; j < 3; j++, at++) {
          product[row][j] = V_x * right[at] + V_y * right[at + 3] + V_z * right[at + 6];
        }
      }
      const [a, b, c] = [dot(left[0], u) + 0.3, dot(left[0], v), dot(left[1], v) + 0.3];
      const determinant = M
        ? square(cross(u, v)) + 0.3 * (square(u) + square(v)) + 0.3 * 0.3
        : a * c - b * b;
      if (!(determinant > 0) || !Number.isFinite(determinant)) continue;
      visible[n] = 1;
      depth[n] = z;
      mean2d.set([(focal[0] / z) * X + center[0], (focal[1] / z) * Y + center[1]], 2 * n);
      cov2d.set([a, b, c], 3 * n);
      conic.set([c / determinant, -b / determinant, a / determinant], 3 * n);
    }
    return { mean2d, cov2d, conic, depth, visible };
  }

  // --- the picture ------------------------------------------------------------------------------
  /** The splats that are visible, from front to back. */
  function frontToBack({ depth, visible }) {
    const order = Array.from(depth.keys()).filter((n) => visible[n]);
    return order.sort((i, j) => depth[i] - depth[j] || i - j);
  }

  /** C = sum_i c_i o_i T_i + T_N background with o = min(alpha_max, alpha exp(...)), [H, W, 3].
   *
   *  Nothing is left out where `least` is 0. Otherwise every Gaussian is drawn within the ellipse
   *  in which o >= least: 5e-5 cannot be seen, 1e-13 is as exact as doubles are. */
  function compositing(splats, { background, size, occlusion, alpha_max = 0.99, least = 0 }) {
    const { mean2d, cov2d, conic, alpha, color } = splats;
    const [width, height] = size;
    const image = new Float64Array(3 * width * height);
    const transmittance = new Float64Array(width * height).fill(1);
    for (const n of frontToBack(splats)) {
      const [A, B, C] = conic.subarray(3 * n, 3 * n + 3);
      const variance = least > 0 ? cov2d[3 * n + 2] : Infinity; // A over the conic's determinant
      const [red, green, blue] = color.subarray(3 * n, 3 * n + 3);
      const [u_0, v_0, opaque] = [mean2d[2 * n], mean2d[2 * n + 1], alpha[n]];
      // alpha exp(-E) >= least where 2 E <= reach; the variance along v gives the rows.
      const reach = least > 0 ? 2 * Math.log(Math.abs(opaque) / least) : Infinity;
      if (!(reach > 0)) continue;
      const tall = Math.sqrt(reach * variance);
      const bottom = Math.min(height - 1, Math.floor(v_0 + tall));
      for (let v = Math.max(0, Math.ceil(v_0 - tall)); v <= bottom; v++) {
        const e_2 = v - v_0;
        const wide = Math.sqrt(Math.max(reach - (e_2 * e_2) / variance, 0) / A);
        const middle = u_0 - (B * e_2) / A;
        const left = least > 0 ? Math.max(0, Math.ceil(middle - wide)) : 0;
        const right = least > 0 ? Math.min(width - 1, Math.floor(middle + wide)) : width - 1;
        const linear_part = B * e_2;
        const constant = 0.5 * C * e_2 * e_2;
        for (let u = left, pixel = v * width + left; u <= right; u++, pixel++) {
          const e_1 = u - u_0;
          const E = (0.5 * A * e_1 + linear_part) * e_1 + constant;
          const o = Math.min(alpha_max, opaque * Math.exp(Math.min(-E, 0)));
          const weight = transmittance[pixel] * o;
          image[3 * pixel] += weight * red;
          image[3 * pixel + 1] += weight * green;
          image[3 * pixel + 2] += weight * blue;
          if (occlusion) transmittance[pixel] -= weight;
        }
      }
    }
    for (let i = 0; i < image.length; i++) {
      image[i] += transmittance[Math.floor(i / 3)] * background[i % 3];
    }
    return { image, transmittance };
  }

  /** The centre of a camera, x_c = -W^T T. */
  const centreOf = ({ W, T }) => [0, 1, 2].map((i) => -dot(T, [W[i], W[3 + i], W[6 + i]]));

  /** The splats of Gaussians at time t. */
  function splatting({ alpha, color }, { x_t, s_t, r_t }, camera) {
    return { ...projection(x_t, { M: root(s_t, r_t) }, camera), alpha, color };
  }

  /** The picture of a model, [height, width, 3], red, green and blue from 0 to 1. */
  function render(model, camera, t, { least = 0 } = {}) {
    const { background, effects } = model.header;
    const gaussians = spatialPrediction(model, centreOf(camera));
    const splats = splatting(gaussians, temporalPrediction(model, gaussians, t), camera);
    const occlusion = effects.includes("occlusion");
    const { image } = compositing(splats, { background, size: camera.size, occlusion, least });
    return image.map((value) => clip(value, 0, 1));
  }

  Object.assign(exported, { Refused, decode, openContainer, hashFeature, layersOf });
  Object.assign(exported, { hashRow, roundHalfEven, mlp, sigmoid, unit, offsets, view, opacity });
  Object.assign(exported, { color, rotation, scale, masking, gather, beside, positionalEncoding });
  Object.assign(exported, { deformation, deformed, rotationMatrix, root, covariance, projection });
  Object.assign(exported, { compositing, spatialPrediction, temporalPrediction, splatting });
  Object.assign(exported, { render, centreOf, gaussianTable, nodesOf, NETWORKS, frontToBack });
  // The text of all this, from which a page starts a worker.
  const source = `"use strict"; (${port})(globalThis.p4dgs = {});`;
  Object.assign(exported, { codingContext, source });
})(typeof module === "object" ? module.exports : (globalThis.p4dgs = {}));
