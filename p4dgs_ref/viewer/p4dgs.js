// A second implementation of P-4DGS: opens a .p4dgs file of version 1 or 2 and draws it.
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
// features. Arrays are typed and flat, row by row; `// [A, k, 3]` says how they are meant.
"use strict";

(function (exported) {
  // --- errors -----------------------------------------------------------------------------------
  /** A file that is refused: its section ("container" for the frame), the byte in it, the kind. */
  class Refused extends Error {
    constructor(section, offset, kind, said) {
      super(`${section}, byte ${offset}: ${said}`);
      Object.assign(this, { section, offset, kind });
    }
  }

  function need(condition, section, offset, kind, said) {
    if (!condition) throw new Refused(section, offset, kind, said);
  }

  // --- small functions on integers --------------------------------------------------------------
  const clip = (v, low, high) => Math.min(Math.max(v, low), high);
  const modulo = (v, m) => v - m * Math.floor(v / m);

  /** The least integer p with v < 2^p, for v > 0. For integers: the number of binary digits. */
  function exponent(v) {
    let p = Math.ceil(Math.log2(v));
    while (2 ** p <= v) p += 1;
    while (2 ** (p - 1) > v) p -= 1;
    return p;
  }

  const bitsOf = (v) => (v > 0 ? exponent(v) : 0);

  /** Rounded to the nearest integer, ties to even. */
  function roundHalfEven(v) {
    const low = Math.floor(v);
    const rest = v - low;
    if (rest !== 0.5) return rest < 0.5 ? low : low + 1;
    return low % 2 === 0 ? low : low + 1;
  }

  /** CRC-32 of parts of bytes: polynomial 0xEDB88320 (reflected), initial and final value ~0. */
  function crc32(...parts) {
    let crc = 0xffffffff;
    for (const part of parts) {
      for (const byte of part) crc = (crc >>> 8) ^ CRC_TABLE[(crc ^ byte) & 255];
    }
    return ~crc >>> 0;
  }

  const CRC_TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
    let crc = byte;
    for (let bit = 0; bit < 8; bit++) crc = crc & 1 ? (crc >>> 1) ^ 0xedb88320 : crc >>> 1;
    return crc;
  });

  // --- the tables of integers, from their formulas ----------------------------------------------
  const table = (length, value) => Float64Array.from({ length }, (_, i) => Math.round(value(i)));

  /** The normal distribution function: 1/2 + phi(z) (z + z^3 / 3 + z^5 / (3 5) + ...). */
  function normal(z) {
    let sum = 0;
    let term = z;
    for (let n = 3; Math.abs(term) > 1e-18; n += 2) {
      sum += term;
      term *= (z * z) / n;
    }
    return 0.5 + (Math.exp((-z * z) / 2) / Math.sqrt(2 * Math.PI)) * sum;
  }

  const PHI = table(769, (i) => 2 ** 24 * normal(i / 64 - 6));
  const EXP2 = table(16, (i) => 2 ** (16 - i / 16));
  const SIGMOID = table(641, (i) => 2 ** 24 / (1 + Math.exp(-2 * (i / 64 - 4))));
  const LOG2 = table(257, (i) => 2 ** 16 * Math.log2(1 + i / 256));
  // Math.exp and Math.log2 may differ in their last digit; no entry is that close to a tie. The
  // checksum of the page's tables, as integers of 4 bytes, says so for the engine at hand.
  const TABLES = [...PHI, ...EXP2, ...SIGMOID, ...LOG2];
  const TABLES_CRC = 0x338ce774;
  if (crc32(new Uint8Array(Uint32Array.from(TABLES).buffer)) !== TABLES_CRC) {
    throw new Error("this engine's Math.exp or Math.log2 is not precise enough");
  }

  // --- container: the frame of the file ---------------------------------------------------------
  const MAGIC = [0x89, 0x50, 0x34, 0x44, 0x0d, 0x0a, 0x1a, 0x0a];
  const SECTIONS = ["header", "positions", "features", "scales", "offset_scales", "offsets"];
  SECTIONS.push("masks", "hash_grid", "deformation_mlp", "anchor_mlps", "context_mlps");
  const MOST_BYTES = 2 ** 29;

  const viewOf = (bytes) => new DataView(bytes.buffer, bytes.byteOffset, bytes.length);

  /** The version of a file and its sections, {name: bytes}; all checksums are right. */
  function openContainer(bytes) {
    const frame = (condition, at, kind, said) => need(condition, "container", at, kind, said);
    const size = bytes.length;
    frame(size >= 18, Math.min(size, 10), "length", "expected at least 18 bytes");
    frame(size <= MOST_BYTES, 10, "length", "expected at most 2^29 bytes");
    frame(MAGIC.every((byte, i) => bytes[i] === byte), 0, "magic", "not a .p4dgs file");
    const version = bytes[8];
    frame(version === 1 || version === 2, 8, "version", `version ${version}, expected 1 or 2`);
    const sections = version === 1 ? readVersion1(bytes, frame) : readVersion2(bytes, frame);
    return { version, sections };
  }

  function readVersion1(bytes, frame) {
    const view = viewOf(bytes);
    const size = bytes.length;
    const S = bytes[9];
    const end = 18 + 9 * S;
    frame(S <= SECTIONS.length, 9, "table", `${S} sections, expected at most 11`);
    frame(view.getUint32(10, true) === size, 10, "length", `not the total length: ${size} bytes`);
    frame(end <= size, 10, "length", "the section table reaches beyond the file");
    const right = crc32(bytes.subarray(0, end - 4)) === view.getUint32(end - 4, true);
    frame(right, end - 4, "checksum", "the checksum of the section table is wrong");
    const sections = {};
    let [last, at] = [0, end];
    for (let row = 14; row < end - 4; row += 9) {
      const id = bytes[row];
      frame(id > last && id <= SECTIONS.length, row, "table", `section ${id} after ${last}`);
      const length = view.getUint32(row + 1, true);
      sections[SECTIONS[id - 1]] = { at, length, crc: view.getUint32(row + 5, true) };
      [last, at] = [id, at + length];
    }
    frame(at === size, 14, "length", `the sections end at byte ${at} of ${size}`);
    for (const [name, { at, length, crc }] of Object.entries(sections)) {
      sections[name] = bytes.subarray(at, at + length);
      need(crc32(sections[name]) === crc, name, 0, "checksum", "the checksum is wrong");
    }
    return sections;
  }

  function readVersion2(bytes, frame) {
    const w = bytes[9];
    frame(w >= 1 && w <= 4, 9, "table", `lengths of ${w} bytes, expected 1 to 4`);
    const end = 14 + 11 * w;
    frame(end <= bytes.length, 10, "length", "the lengths reach beyond the file");
    const sections = {};
    let at = end;
    SECTIONS.forEach((name, i) => {
      let stored = 0;
      for (let byte = w - 1; byte >= 0; byte--) stored = 256 * stored + bytes[10 + i * w + byte];
      if (stored === 0) return;
      sections[name] = bytes.subarray(at, Math.min(at + stored - 1, bytes.length));
      at += stored - 1;
    });
    frame(at === bytes.length, 10, "length", `the sections end at byte ${at} of ${bytes.length}`);
    const crc = crc32(bytes.subarray(0, end - 4), bytes.subarray(end));
    const right = crc === viewOf(bytes).getUint32(end - 4, true);
    frame(right, end - 4, "checksum", "the checksum of the file is wrong");
    return sections;
  }

  // --- header: the design, and what it promises -------------------------------------------------
  const MOTION = ["translation", "scaling", "rotation"]; // in the order of the heads of psi_d
  const EFFECTS = [...MOTION, "view_color", "view_geometry", "occlusion", "background"];

  const isWhole = (low, high) => (v) => Number.isInteger(v) && low <= v && v <= high;
  const isReal = (low, high) => (v) => typeof v === "number" && low <= v && v <= high;
  const isList = (low, high, is) => (v) =>
    Array.isArray(v) && low <= v.length && v.length <= high && v.every(is);
  const isWidths = (low) => isList(low, 8, isWhole(1, 2 ** 14));
  const isLevel = (v) =>
    isList(2, 2, () => true)(v) &&
    ["xyz", "xy", "xz", "yz"].includes(v[0]) &&
    isWhole(1, 2 ** 16)(v[1]);
  const isEffects = (v) =>
    isList(0, 7, (name) => EFFECTS.includes(name))(v) && new Set(v).size === v.length;

  const FIELDS = {
    anchors: isWhole(1, 2 ** 22),
    background: isList(3, 3, isReal(-(2 ** 20), 2 ** 20)),
    d: isWhole(1, 4096),
    k: isWhole(1, 256),
    hidden: isWidths(0),
    deformation: isWidths(0),
    L_x: isWhole(1, 64),
    L_t: isWhole(1, 64),
    context: isWidths(0),
    grid: isList(1, 64, isLevel),
    table: isList(2, 2, isWhole(1, 2 ** 24)),
    F: isWhole(1, 64),
    Q_0: isList(4, 4, isReal(2 ** -100, 2 ** 100)),
    tau_alpha: isReal(-1, 1),
    effects: isEffects,
  };
  const REAL = ["background", "Q_0", "tau_alpha"];
  const OPTIONAL = { time_net: isWidths(1), skip: (v) => v === true };
  const ONLY_2 = { position_bits: isWhole(1, 16) };

  const PLANES = (R) => ["xy", "xz", "yz"].flatMap((axes) => R.map((r) => [axes, r]));
  const HAC_3D = [18, 24, 33, 44, 59, 80, 108, 148, 201, 275, 376, 514];
  const BASES = {
    tiny: {
      background: [1, 1, 1],
      d: 16,
      k: 4,
      hidden: [32, 32],
      deformation: [64, 64],
      L_x: 4,
      L_t: 4,
      context: [16, 16],
      grid: [["xyz", 8], ...PLANES([16])],
      table: [8192, 32768],
      F: 2,
      Q_0: [0.25, 0.01, 0.01, 0.1],
      tau_alpha: 0,
      effects: ["translation", "view_color", "occlusion", "background"],
      position_bits: 10,
    },
    paper: {
      background: [1, 1, 1],
      d: 16,
      k: 10,
      hidden: [32, 32],
      deformation: [192, 192],
      L_x: 10,
      L_t: 6,
      context: [32, 32],
      grid: [...HAC_3D.map((R) => ["xyz", R]), ...PLANES([130, 258, 514, 1026])],
      table: [8192, 32768],
      F: 4,
      Q_0: [1, 0.001, 0.001, 0.2],
      tau_alpha: 0,
      effects: [...MOTION, "view_color", "view_geometry", "occlusion", "background"],
      position_bits: 16,
    },
  };

  const JSON_TOKEN = /"(?:[^"\\]|\\.)*"(\s*:)?|-?\d[\d.eE+-]*/g;

  /** The JSON object as it stands in the file. A number such as 4.0 is not taken for an integer. */
  function parseHeader(body) {
    const bad = (said) => new Refused("header", 0, "header", said);
    if (body.length > 2 ** 14) throw bad("expected at most 2^14 bytes");
    if (body.some((byte) => byte > 127)) throw bad("expected ASCII");
    const text = String.fromCharCode(...body);
    let [keys, fields] = [0, null];
    // JSON.parse keeps the last of two equal keys, and does not tell 4.0 from 4. So count the keys,
    // and parse again with {"real": 4.0} in the place of 4.0.
    const marked = text.replace(JSON_TOKEN, (token, colon) => {
      keys += colon ? 1 : 0;
      return token[0] !== '"' && /[.eE]/.test(token) ? `{"real": ${token}}` : token;
    });
    try {
      JSON.parse(text);
      fields = JSON.parse(marked);
    } catch {
      throw bad("expected a JSON object");
    }
    if (fields === null || typeof fields !== "object" || Array.isArray(fields)) {
      throw bad("expected a JSON object");
    }
    if (keys !== Object.keys(fields).length) throw bad("a field occurs twice, or within another");
    const plain = (v) => (Array.isArray(v) ? v.map(plain) : (v?.real ?? v));
    for (const name of REAL) if (Object.hasOwn(fields, name)) fields[name] = plain(fields[name]);
    return fields;
  }

  /** The checked header, completed by its base design. */
  function readHeader(body, version) {
    const good = (condition, said) => need(condition, "header", 0, "header", said);
    const own = parseHeader(body);
    let header = own;
    if (version === 2) {
      const { as, ...rest } = own;
      good(Object.hasOwn(BASES, as ?? ""), "field as: expected the name of a base design");
      header = { ...BASES[as], ...rest };
    }
    const needed = version === 2 ? { ...FIELDS, ...ONLY_2 } : FIELDS;
    const known = { ...needed, ...OPTIONAL };
    for (const name of Object.keys(needed)) good(Object.hasOwn(header, name), `no field ${name}`);
    for (const [name, value] of Object.entries(header)) {
      good(Object.hasOwn(known, name) && known[name](value), `field ${name} is unknown or wrong`);
    }
    const deep = !header.skip || header.deformation.length >= 3;
    good(deep, "field skip: expected at least 3 widths of deformation");
    return Object.assign(header, { own });
  }

  const nodesOf = (header, [axes, R]) =>
    Math.min(R ** axes.length, header.table[axes.length === 3 ? 0 : 1]);

  /** Every network as a list of its layers [I, J], {psi_alpha: [[20, 32], ...], ...}. */
  function layersOf(header) {
    const { d, k, F, hidden, effects, deformation } = header;
    const chain = (widths) => widths.slice(1).map((J, i) => [widths[i], J]);
    const view = (effect) => d + (effects.includes(effect) ? 4 : 0);
    const h = F * header.grid.length;
    const E_t = 1 + 2 * header.L_t;
    const heads = MOTION.filter((effect) => effects.includes(effect));
    const time = header.time_net ? chain([E_t, ...header.time_net]) : [];
    const inputs = 3 * (1 + 2 * header.L_x) + (time.length ? time.at(-1)[1] : E_t);
    const trunk = chain([inputs, ...deformation]);
    if (header.skip) trunk[skipOf(trunk)][0] += inputs;
    const width = deformation.length ? deformation.at(-1) : inputs;
    const ends = heads.map((effect) => [width, effect === "rotation" ? 4 : 3]);
    return {
      psi_alpha: chain([view("view_geometry"), ...hidden, k]),
      psi_c: chain([view("view_color"), ...hidden, 3 * k]),
      psi_r: chain([view("view_geometry"), ...hidden, 4 * k]),
      psi_s: chain([view("view_geometry"), ...hidden, 3 * k]),
      psi_p: chain([h, ...header.context, 2 * (d + 6 + 3 * k)]),
      psi_q: chain([h, ...header.context, 4]),
      psi_d: heads.length ? [...trunk, ...ends] : [],
      psi_t: heads.length ? time : [],
    };
  }

  /** With a skip, the layer of psi_d that reads the inputs again. */
  const skipOf = (trunk) => Math.floor(trunk.length / 2) + 1;

  /** Refuses a header that promises more numbers or work than a file of n bytes may. */
  function checkLimits(header, layers, n) {
    const good = (condition, said) => need(condition, "header", 0, "header", said);
    const { anchors, d, k, F, grid } = header;
    const sum = (values) => values.reduce((a, b) => a + b, 0);
    const entries = sum(grid.map((level) => nodesOf(header, level) * F));
    const weights = sum(Object.values(layers).flat().map(([I, J]) => I * J + J));
    const numbers = anchors * (9 + d + 4 * k) + entries + weights;
    const reads = sum(grid.map(([axes]) => 2 ** axes.length * 64 * (F + 8)));
    const context = sum([...layers.psi_p, ...layers.psi_q].map(([I, J]) => I * J));
    good(entries <= 2 ** 24, `${entries} entries of the grid, expected at most 2^24`);
    good(numbers <= 2 ** 25, `${numbers} numbers, expected at most 2^25`);
    good(numbers <= 2 ** 22 + 16 * n, `${numbers} numbers are too many for a file of this size`);
    const work = anchors * (context + reads);
    good(work <= 2 ** 34 + 2 ** 15 * n, "too much work for a file of this size");
  }

  // --- rANS: messages of entries from frequency tables ------------------------------------------
  // The state x < 2^63 is a pair of 32-bit numbers: x = hi 2^32 + lo.
  const TWO_32 = 2 ** 32;

  class Message {
    /** Reads a message of n symbols from byte `at` of a section. */
    constructor(section, bytes, at, n) {
      Object.assign(this, { section, bytes, at, n, given: [], next: 0, lanes: [], tail: n });
      if (n === 0) return;
      this.need(at < bytes.length, "the message is missing");
      const first = bytes[at];
      const [start, L] = [at, 2 ** (first & 15)];
      this.need(L <= 1024 && (first & 0x70) === 0, "expected at most 2^10 lanes, and zero bits");
      this.at += 1;
      if (L > 1) this.tail = this.word();
      const whole = this.tail <= n && (n - this.tail) % L === 0 && (L === 1 || this.tail > 0);
      this.need(whole, `a tail of ${this.tail} of ${n} symbols in ${L} lanes`, start + 1);
      const state = this.at;
      const lo = this.word();
      const hi = first & 128 ? this.word() : 0;
      this.need(hi > 0 || !(first & 128), "a high word that is zero", state);
      this.need(hi < 2 ** 31 && (hi > 0 || lo >= 2 ** 31), "an impossible state", state);
      this.lanes = [{ hi, lo }];
      for (let lane = 1; lane < L; lane++) this.lanes.push(this.opened(this.lanes[0]));
    }

    need(condition, said, at = this.at) {
      need(condition, this.section, at, "stream", said);
    }

    /** The next word: of those that ended lanes gave back, else of the file. */
    word() {
      if (this.given.length) return this.given.pop();
      this.need(this.at + 4 <= this.bytes.length, "the message ends early");
      this.at += 4;
      return viewOf(this.bytes).getUint32(this.at - 4, true);
    }

    refill(x) {
      if (x.hi > 0 || x.lo >= 2 ** 31) return;
      x.hi = x.lo;
      x.lo = this.word();
    }

    popBits(x, b) {
      const v = x.lo % 2 ** b;
      x.lo = (x.hi % 2 ** b) * 2 ** (32 - b) + Math.floor(x.lo / 2 ** b);
      x.hi = Math.floor(x.hi / 2 ** b);
      this.refill(x);
      return v;
    }

    opened(x) {
      const n = this.popBits(x, 5);
      const high = 2 ** n + this.popBits(x, n);
      const low = this.popBits(x, 31);
      return { hi: Math.floor(high / 2), lo: (high % 2) * 2 ** 31 + low };
    }

    /** Lane x ends; its 31 low bits go back to lane 0. */
    ended(x, zero) {
      this.need(x.hi === 0 && x.lo >= 2 ** 31, "a lane does not end where lanes start");
      if (zero.hi > 0) {
        this.given.push(zero.lo);
        zero.lo = zero.hi;
      }
      zero.hi = Math.floor(zero.lo / 2);
      zero.lo = (zero.lo % 2) * 2 ** 31 + (x.lo - 2 ** 31);
    }

    /** The lane that holds the next symbol. */
    turn() {
      const { lanes, n, tail } = this;
      const i = this.next;
      this.next += 1;
      if (i === n - tail) while (lanes.length > 1) this.ended(lanes.pop(), lanes[0]);
      return lanes[i < n - tail ? i % lanes.length : 0];
    }

    /** Takes the entry [start, start + freq) off a lane: x = floor(x / 2^24) freq + slot - start.
     *  x is below 2^63, so its quotient is taken in two parts, of which each product fits. */
    pop(x, start, freq) {
      const slot = x.lo & 0xffffff;
      const quotient = x.hi * 256 + (x.lo >>> 24);
      const high = Math.floor(quotient / 2 ** 24) * freq;
      const low = (quotient % 2 ** 24) * freq + slot - start + (high % 256) * 2 ** 24;
      x.hi = Math.floor(high / 256) + Math.floor(low / TWO_32);
      x.lo = low % TWO_32;
      this.refill(x);
    }

    /** After the last symbol: the byte behind the message. */
    end() {
      const whole = this.n === 0 || (this.lanes[0].hi === 0 && this.lanes[0].lo === 2 ** 31);
      this.need(whole && this.lanes.length < 2, "the message does not end at its first state");
      this.need(this.given.length === 0, "the message ends before its last word");
      return this.at;
    }
  }

  // --- raw bits ---------------------------------------------------------------------------------
  class Bits {
    /** Bits from byte `at` of a section to its end, every byte from its lowest bit on. */
    constructor(section, bytes, at) {
      Object.assign(this, { section, bytes, start: at, place: 8 * at });
    }

    need(condition, said) {
      need(condition, this.section, this.start, "stream", said);
    }

    bit() {
      const byte = Math.floor(this.place / 8);
      this.need(byte < this.bytes.length, "the raw bits end early");
      const bit = (this.bytes[byte] >> this.place % 8) & 1;
      this.place += 1;
      return bit;
    }

    number(count) {
      let v = 0;
      for (let i = 0; i < count; i++) v += this.bit() * 2 ** i;
      return v;
    }

    /** Elias's gamma code: b zeros, a one, the b low bits of the number. */
    gamma() {
      let b = 0;
      while (!this.bit()) {
        b += 1;
        this.need(b <= 33, "a number of more than 34 bits");
      }
      return 2 ** b + this.number(b);
    }

    end() {
      this.need(this.bytes.length === Math.ceil(this.place / 8), "bytes are left over");
      while (this.place % 8) this.need(!this.bit(), "a bit that is not in use");
    }
  }

  // --- the frequency table of a symbol ----------------------------------------------------------
  /** A Gaussian with its own mean and deviation: the blocks c-W ... c+W, low bits, and cum(K). */
  class GaussianTable {
    set(mu_units, sigma_units) {
      const e = Math.floor(sigma_units / 16);
      const step = 2 ** Math.max(e + 6, 0);
      this.mean = Math.floor((mu_units + Math.floor(step / 2)) / step) * step;
      this.low = Math.max(e - 4, 0);
      this.unit = 2 ** (10 + this.low);
      this.W = 1 + Math.ceil(12 * 2 ** Math.min(e, 4));
      this.c = Math.floor((this.mean + 512) / this.unit);
      this.n = 2 * this.W + 1;
      this.exp2 = EXP2[modulo(sigma_units, 16)];
      this.divisor = 2 ** (12 + e);
      return this;
    }

    /** The distribution function at the lower boundary of block c - W + j, plus j. */
    cum(j) {
      const boundary = (this.c - this.W + j) * this.unit - 512 - this.mean;
      const z = clip(Math.floor((boundary * this.exp2) / this.divisor), -98304, 98303);
      const i = Math.floor(z / 256);
      const r = z - 256 * i;
      const below = PHI[i + 384];
      const C = below + Math.floor(((PHI[i + 385] - below) * r) / 256);
      return Math.floor((C * (2 ** 24 - this.n - 1)) / 2 ** 24) + j;
    }

    /** Takes the next symbol's block off a message: its number from c - W on, n for the escape. */
    read(message) {
      const x = message.turn();
      const slot = x.lo & 0xffffff;
      if (slot === 2 ** 24 - 1) {
        message.pop(x, slot, 1);
        return this.n;
      }
      let [low, high, start, end] = [0, this.n, 0, 2 ** 24 - 1];
      while (high - low > 1) {
        const middle = (low + high) >> 1;
        const at = this.cum(middle);
        if (at <= slot) [low, start] = [middle, at];
        else [high, end] = [middle, at];
      }
      message.pop(x, start, end - start);
      return low;
    }
  }

  /** The n symbols of a Gaussian stream that fills a section from byte `at` on.
   *  `units(i)` is [mu_units, sigma_units] of symbol i, `put(i, symbol)` receives it. */
  function readGaussians(section, bytes, at, n, units, put) {
    if (n === 0) {
      need(bytes.length === at, section, at, "stream", "bytes are left over");
      return;
    }
    const table = new GaussianTable();
    const message = new Message(section, bytes, at, n);
    const blocks = new Int16Array(n); // from c - W on; n of the table for an escape
    for (let i = 0; i < n; i++) blocks[i] = table.set(...units(i)).read(message);
    const bits = new Bits(section, bytes, message.end());
    const lows = new Uint16Array(n);
    for (let i = 0; i < n; i++) lows[i] = bits.number(table.set(...units(i)).low);
    for (let i = 0; i < n; i++) {
      const { c, W, low, n: escape } = table.set(...units(i));
      let K = c - W + blocks[i];
      if (blocks[i] === escape) {
        const v = bits.gamma();
        K = v % 2 ? c + W + 1 + (v - 1) / 2 : c - W - v / 2;
      }
      const symbol = K * 2 ** low + lows[i];
      bits.need(Math.abs(symbol) <= 2 ** 31, `a symbol of ${symbol}, beyond 2^31`);
      put(i, symbol);
    }
    bits.end();
  }

  /** A bit stream: n bits that share the probability f / 2^24 of a one. */
  function readBits(section, bytes, n) {
    const found = new Uint8Array(n);
    const short = n === 0 ? bytes.length === 0 : bytes.length >= 4;
    need(short, section, 0, "stream", "the stream has not its length");
    if (n === 0) return found;
    const f = viewOf(bytes).getUint32(0, true);
    need(f <= 2 ** 24, section, 0, "stream", "a probability above 1");
    let end = 4;
    if (f === 0 || f === 2 ** 24) found.fill(f ? 1 : 0);
    else {
      const message = new Message(section, bytes, 4, n);
      const zeros = 2 ** 24 - f;
      for (let i = 0; i < n; i++) {
        const x = message.turn();
        found[i] = (x.lo & 0xffffff) >= zeros ? 1 : 0;
        if (found[i]) message.pop(x, zeros, f);
        else message.pop(x, 0, zeros);
      }
      end = message.end();
    }
    need(end === bytes.length, section, end, "stream", "bytes are left over");
    return found;
  }

  // --- positions --------------------------------------------------------------------------------
  /** The box {lo, hi} and 16 bits per coordinate, [A, 3]. */
  function readPositions(body, header, version) {
    const A = header.anchors;
    const size = version === 1 ? 24 + 6 * A : body.length;
    const at = Math.min(body.length, Math.max(size, 24));
    const whole = body.length === size && size >= 24;
    need(whole, "positions", at, "length", `${body.length} bytes for ${A} anchors`);
    const view = viewOf(body);
    const corner = (from) => [0, 1, 2].map((i) => view.getFloat32(from + 4 * i, true));
    const [lo, hi] = [corner(0), corner(12)];
    for (let i = 0; i < 3; i++) {
      const right = -1e30 <= lo[i] && lo[i] <= hi[i] && hi[i] <= 1e30;
      need(right, "positions", 0, "number", `the box from ${lo[i]} to ${hi[i]}`);
    }
    if (version === 2) return { lo, hi, positions: readSorted(body, header, lo, hi) };
    const read = (_, i) => view.getUint16(24 + 2 * i, true);
    return { lo, hi, positions: Uint16Array.from({ length: 3 * A }, read) };
  }

  /** Positions of version 2: gaps between codes in ascending order, on a lattice of B bits. */
  function readSorted(body, header, lo, hi) {
    const [A, B] = [header.anchors, header.position_bits];
    const axes = [0, 1, 2].filter((i) => lo[i] < hi[i]);
    const digits = axes.length * B;
    need(body.length > 24, "positions", 24, "stream", "the gaps are missing");
    const r = body[24];
    need(r <= digits, "positions", 24, "stream", `${r} raw bits in gaps of ${digits}`);
    const bits = new Bits("positions", body, 25);
    const gaps = Float64Array.from({ length: A }, () => bits.number(r));
    const positions = new Uint16Array(3 * A);
    const L = 2 ** B - 1;
    let code = 0;
    for (let a = 0; a < A; a++) {
      code += gaps[a] + (bits.gamma() - 1) * 2 ** r;
      need(code < 2 ** digits, "positions", 24, "stream", "the gaps add up to too much");
      const m = [0, 0, 0];
      let rest = code;
      for (let bit = 0; bit < B; bit++) {
        for (let axis = axes.length - 1; axis >= 0; axis--) {
          m[axes[axis]] += (rest % 2) * 2 ** bit;
          rest = Math.floor(rest / 2);
        }
      }
      for (let i = 0; i < 3; i++) {
        positions[3 * a + i] = Math.floor((65535 * m[i] + Math.floor(L / 2)) / L);
      }
    }
    bits.end();
    return positions;
  }

  // --- networks in the file ---------------------------------------------------------------------
  const NETWORKS = {
    anchor_mlps: ["psi_alpha", "psi_c", "psi_r", "psi_s"],
    context_mlps: ["psi_p", "psi_q"],
    deformation_mlp: ["psi_d", "psi_t"],
  };

  function float16(bits) {
    const [sign, e, m] = [bits & 0x8000 ? -1 : 1, (bits >> 10) & 31, bits & 1023];
    if (e === 31) return m ? NaN : sign * Infinity;
    return sign * (e ? (1024 + m) * 2 ** (e - 25) : m * 2 ** -24);
  }

  /** The networks of a section, {name: [{I, J, W, b}, ...]}. */
  function readNetworks(section, body, shapes, version) {
    const layers = NETWORKS[section].flatMap((name) => shapes[name]);
    const count = layers.reduce((sum, [I, J]) => sum + I * J + J, 0);
    const read = version === 1 ? readFloat16 : readCoded;
    const numbers = read(section, body, layers, count);
    let at = 0;
    const take = (length) => numbers.subarray(at, (at += length));
    const layer = ([I, J]) => ({ I, J, W: take(I * J), b: take(J) });
    return Object.fromEntries(NETWORKS[section].map((name) => [name, shapes[name].map(layer)]));
  }

  function readFloat16(section, body, _, count) {
    const at = Math.min(body.length, 2 * count);
    need(body.length === 2 * count, section, at, "length", `expected ${count} numbers`);
    const view = viewOf(body);
    return Float64Array.from({ length: count }, (_, i) => {
      const number = float16(view.getUint16(2 * i, true));
      need(Number.isFinite(number), section, 2 * i, "number", `the weight ${number}`);
      return number;
    });
  }

  /** B1: integers times a step for each tensor, coded with scales of rows and columns. */
  function readCoded(section, body, layers, count) {
    const tensors = layers.flatMap(([I, J]) => [{ I, J, coded: true }, { I: J, J: 1 }]);
    const end = 2 * tensors.length;
    need(body.length >= end, section, body.length, "length", "levels are missing");
    tensors.forEach((tensor, i) => {
      const t = body[2 * i + 1];
      need(t <= 27, section, 2 * i + 1, "number", `a level of ${t}, expected at most 27`);
      Object.assign(tensor, { s: body[2 * i], t: t - 8 });
    });
    const lengths = tensors.map(({ I, J, coded }) => (coded ? I + J : 0));
    const total = lengths.reduce((a, b) => a + b, 0);
    const message = new Message(section, body, end, total);
    const table = new GaussianTable().set(0, 0);
    const codes = Int8Array.from({ length: total }, () => {
      const block = table.read(message);
      message.need(block < table.n, "a code beyond 13");
      return block - table.W;
    });
    const steps = new Float64Array(count);
    const sigma = new Int16Array(count);
    let [n, at] = [0, 0];
    tensors.forEach(({ I, J, s, t, coded }, tensor) => {
      const step = (16 + (s % 16)) * 2 ** (Math.floor(s / 16) - 19);
      for (let i = 0; i < I; i++) {
        for (let j = 0; j < J; j++, n++) {
          const scale = coded ? codes[at + i] + codes[at + I + j] : 0;
          sigma[n] = 16 * clip(t + scale, -8, 19);
          steps[n] = step;
        }
      }
      at += lengths[tensor];
    });
    const units = (i) => [0, sigma[i]];
    readGaussians(section, body, message.end(), count, units, (i, symbol) => {
      need(Math.abs(symbol) <= 32767, section, 0, "number", `a weight of ${symbol} steps`);
      steps[i] *= symbol;
    });
    return steps;
  }

  // --- the coding context, in integers ----------------------------------------------------------
  /** A network in integers: weights W' = W 2^n, biases b' = b 2^(a + n), and its bounds. */
  function integerNetwork(layers) {
    let [a, X] = [15, 2 ** 15];
    const whole = layers.map(({ I, J, W, b }, index) => {
      const largest = (v) => v.reduce((most, w) => Math.max(most, Math.abs(w)), 0);
      const digits = (v) => (v > 0 ? exponent(v) : 0);
      const n = Math.min(15 - digits(largest(W)), 50 - digits(largest(b)) - a, 24);
      const W_n = W.map((w) => roundHalfEven(w * 2 ** n));
      const b_n = b.map((w) => roundHalfEven(w * 2 ** (a + n)));
      const sums = new Float64Array(J);
      for (let i = 0; i < I * J; i++) sums[i % J] += Math.abs(W_n[i]);
      const B = X * largest(sums) + largest(b_n);
      const hidden = index < layers.length - 1;
      const s = hidden ? Math.max(0, bitsOf(B) - 22) : 0;
      X = Math.floor((B + Math.floor(2 ** s / 2)) / 2 ** s);
      a += n - s;
      return { I, J, W: W_n, b: b_n, s, hidden, y: new Float64Array(J) };
    });
    return { layers: whole, a, B: X };
  }

  /** The outputs of an integer network; the next call overwrites them. */
  function runInteger(network, x) {
    for (const { I, J, W, b, s, hidden, y } of network.layers) {
      y.set(b);
      for (let i = 0; i < I; i++) {
        if (x[i] === 0) continue;
        for (let j = 0; j < J; j++) y[j] += x[i] * W[i * J + j];
      }
      const half = Math.floor(2 ** s / 2);
      for (let j = 0; hidden && j < J; j++) y[j] = Math.max(0, Math.floor((y[j] + half) / 2 ** s));
      x = y;
    }
    return x;
  }

  /** An output y in units of 2^-a, in units of 2^-c. */
  function inUnits(y, a, c) {
    if (a <= c) return y * 2 ** (c - a);
    return Math.floor((y + 2 ** (a - c - 1)) / 2 ** (a - c));
  }

  /** The row of a node: i + j R + k R^2, or where the table is too small, the hash of Q11. */
  function hashRow(corner, R, T) {
    const [i, j, k = 0] = corner;
    if (R ** corner.length <= T) return i + j * R + k * R * R;
    return ((i ^ Math.imul(j, 2654435761) ^ Math.imul(k, 805459861)) >>> 0) % T;
  }

  /** Eq. (9): h = H(x_a), in units of 2^-15. `signs` holds 1 for +1 and 0 for -1. */
  function hashFeature(model, anchor, h) {
    const { header, positions, signs } = model;
    const F = header.F;
    let [first, out] = [0, 0];
    for (const [axes, R] of header.grid) {
      const D = axes.length;
      const T = nodesOf(header, [axes, R]);
      const cell = [...axes].map((axis) => {
        const n = positions[3 * anchor + "xyz".indexOf(axis)];
        const base = Math.floor((n * (R - 1)) / 65535);
        return { base, t: n * (R - 1) - 65535 * base };
      });
      const sums = new Float64Array(F);
      for (let corner = 0; corner < 2 ** D; corner++) {
        const upper = cell.map((_, i) => (corner >> i) & 1);
        const weight = cell.reduce((w, { t }, i) => w * (upper[i] ? t : 65535 - t), 1);
        const node = cell.map(({ base }, i) => Math.min(base + upper[i], R - 1));
        const at = first + hashRow(node, R, T) * F;
        for (let f = 0; f < F; f++) sums[f] += signs[at + f] ? weight : -weight;
      }
      const Q = Math.floor(65535 ** D / 2 ** 15);
      for (const v of sums) h[out++] = Math.floor((v + Math.floor(Q / 2)) / Q);
      first += T * F;
    }
    return h;
  }

  /** Eq. (8): q = Q_0 (1 + tanh(psi_q(h))), as q_units of Q_0 2^-15. */
  function stepUnits(y, a) {
    const u = clip(inUnits(y, a, 12), -(2 ** 15), 2 ** 15);
    const v = clip(u + 4 * 2 ** 12, 0, 10 * 2 ** 12 - 1);
    const [i, r] = [Math.floor(v / 64), v % 64];
    const share = SIGMOID[i] + Math.floor(((SIGMOID[i + 1] - SIGMOID[i]) * r) / 64);
    return clip(Math.floor((share + 128) / 256), 32, 65536);
  }

  /** What means and deviations need of a step: Q_0 = f 2^p, D and n, and R, about 1 / q. */
  function reciprocal(Q_0, q_units) {
    const p = exponent(Q_0);
    const D = Math.floor(2 ** 24 * (Q_0 / 2 ** p)) * q_units;
    const n = bitsOf(D) - 24;
    const top = Math.floor(D / 2 ** n);
    return { p, n, top, R: Math.floor(2 ** 47 / top) };
  }

  /** Eq. (12), the mean: mu / q in units of 1/1024. */
  function meanUnits(y, a, B, { p, n, R }) {
    const t = Math.max(0, bitsOf(B) - 28);
    const m = Math.floor((y + Math.floor(2 ** t / 2)) / 2 ** t);
    const S = a - t + p + n - 2;
    return clip(Math.floor(m * R * 2 ** -S + 0.5), -(2 ** 34), 2 ** 34);
  }

  /** Eq. (12), the deviation: log2(sigma / q) in units of 1/16. */
  function deviationUnits(y, a, { p, n, top }) {
    const raw = clip(inUnits(y, a, 16), -14 * 2 ** 16, 6 * 2 ** 16);
    const log2_sigma = Math.floor((94548 * raw + 2 ** 15) / 2 ** 16);
    const i = Math.floor((top - 2 ** 23) / 2 ** 15);
    const r = top - 2 ** 23 - 2 ** 15 * i;
    const between = Math.floor(((LOG2[i + 1] - LOG2[i]) * r) / 2 ** 15);
    const log2_D = (n + 23) * 2 ** 16 + LOG2[i] + between;
    const units = Math.floor((log2_sigma - log2_D - (p - 39) * 2 ** 16 + 2 ** 11) / 2 ** 12);
    return clip(units, -128, 319);
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
      runInteger(psi_q, h).forEach((y, g) => (q_units[4 * a + g] = stepUnits(y, psi_q.a)));
      const y = runInteger(psi_p, h);
      let [out, at] = [a * columns, 0];
      groups.forEach(({ width }, g) => {
        const step = reciprocal(header.Q_0[g], q_units[4 * a + g]);
        for (let i = 0; i < width; i++, out++) {
          mu_units[out] = meanUnits(y[at + i], psi_p.a, psi_p.B, step);
          sigma_units[out] = deviationUnits(y[at + width + i], psi_p.a, step);
        }
        at += 2 * width;
      });
    }
    const q = Float64Array.from(q_units, (units, i) => units * (header.Q_0[i % 4] * 2 ** -15));
    return { q_units, q, mu_units, sigma_units };
  }

  // --- a file -----------------------------------------------------------------------------------
  /** The model in a file of version 1 or 2. Throws Refused. */
  function decode(bytes) {
    const { version, sections } = openContainer(bytes);
    need(sections.header, "header", 0, "missing", "the section is missing");
    const header = readHeader(sections.header, version);
    const shapes = layersOf(header);
    const total = Object.values(sections).reduce((sum, body) => sum + body.length, 0);
    checkLimits(header, shapes, total);
    for (const name of SECTIONS) {
      const asked = name !== "deformation_mlp" || shapes.psi_d.length > 0;
      need(sections[name] || !asked, name, 0, "missing", "the section is missing");
      need(!sections[name] || asked, name, 0, "unexpected", "no effect that needs this section");
    }
    const { anchors: A, d, k } = header;
    const groups = [
      { name: "f_a", section: "features", width: d, first: 0 },
      { name: "s_a", section: "scales", width: 3, first: d },
      { name: "l_a", section: "offset_scales", width: 3, first: d + 3 },
      { name: "O_a", section: "offsets", width: 3 * k, first: d + 6 },
    ];
    const columns = d + 6 + 3 * k;
    const model = { version, header, groups, columns, bytes: {} };
    for (const name of Object.keys(sections)) model.bytes[name] = sections[name].length;
    Object.assign(model, readPositions(sections.positions, header, version));
    const networks = Object.keys(NETWORKS)
      .filter((name) => sections[name])
      .map((name) => readNetworks(name, sections[name], shapes, version));
    model.networks = Object.assign({ psi_d: [], psi_t: [] }, ...networks);
    const entries = header.grid.reduce((sum, level) => sum + nodesOf(header, level) * header.F, 0);
    model.signs = readBits("hash_grid", sections.hash_grid, entries);
    model.masks = readBits("masks", sections.masks, A * k);
    Object.assign(model, codingContext(model));
    model.x_a = Float64Array.from(model.positions, (n, i) => {
      const [lo, hi] = [model.lo[i % 3], model.hi[i % 3]];
      return lo + n * ((hi - lo) / 65535);
    });
    model.symbols = new Float64Array(A * columns);
    for (const group of groups) readAttributes(model, group, sections[group.section]);
    return model;
  }

  /** Eq. (10) backwards: f = symbol q, for one group of attributes. */
  function readAttributes(model, { name, section, width, first }, body) {
    const { header, masks, mu_units, sigma_units, symbols, columns } = model;
    const g = model.groups.findIndex((group) => group.name === name);
    const isOffsets = name === "O_a";
    const coded = isOffsets ? 3 * masks.reduce((a, b) => a + b, 0) : header.anchors * width;
    const where = new Int32Array(coded);
    let n = 0;
    for (let a = 0; a < header.anchors; a++) {
      for (let i = 0; i < width; i++) {
        const kept = !isOffsets || masks[a * header.k + Math.floor(i / 3)];
        if (kept) where[n++] = a * columns + first + i;
      }
    }
    const units = (i) => [mu_units[where[i]], sigma_units[where[i]]];
    readGaussians(section, body, 0, n, units, (i, symbol) => (symbols[where[i]] = symbol));
    model[name] = new Float64Array(header.anchors * width);
    for (let a = 0; a < header.anchors; a++) {
      for (let i = 0; i < width; i++) {
        model[name][a * width + i] = symbols[a * columns + first + i] * model.q[4 * a + g];
      }
    }
  }

  // --- networks in floats -----------------------------------------------------------------------
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

  /** y = W_n relu(... relu(x W_0 + b_0) ...) + b_n */
  function mlp(layers, x, rows) {
    layers.forEach((layer, i) => (x = linear(layer, x, rows, i < layers.length - 1)));
    return x;
  }

  /** Arrays of `rows` rows side by side; `parts` are pairs [array, width]. */
  function beside(rows, ...parts) {
    const width = parts.reduce((sum, part) => sum + part[1], 0);
    const all = new Float64Array(rows * width);
    let first = 0;
    for (const [array, w] of parts) {
      for (let row = 0; row < rows; row++) {
        for (let i = 0; i < w; i++) all[row * width + first + i] = array[row * w + i];
      }
      first += w;
    }
    return all;
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

  /** Eq. (1): x = x_a + O_a * l_a, for every child, [A, k, 3]. */
  function offsets(x_a, O_a, l_a) {
    const k = x_a.length ? O_a.length / x_a.length : 0;
    return O_a.map((O, i) => {
      const at = 3 * Math.floor(i / (3 * k)) + (i % 3);
      return x_a[at] + O * l_a[at];
    });
  }

  /** Eq. (2): delta_vc = |x_a - x_c|, d_vc = (x_a - x_c) / delta_vc, zeros at distance 0. */
  function view(x_a, x_c) {
    const delta_vc = new Float64Array(x_a.length / 3);
    const d_vc = x_a.map((x, i) => x - x_c[i % 3]);
    for (let a = 0; a < delta_vc.length; a++) {
      delta_vc[a] = Math.hypot(d_vc[3 * a], d_vc[3 * a + 1], d_vc[3 * a + 2]);
      for (let i = 3 * a; i < 3 * a + 3; i++) d_vc[i] = delta_vc[a] ? d_vc[i] / delta_vc[a] : 0;
    }
    return { delta_vc, d_vc };
  }

  /** Eq. (3): alpha = tanh(psi_alpha(f_a, delta_vc, d_vc)), [A, k]. `inputs` are those three. */
  const opacity = (psi_alpha, inputs, A) => mlp(psi_alpha, inputs, A).map(Math.tanh);

  /** Eq. (3'): color = sigmoid(psi_c(f_a, delta_vc, d_vc)), [A, k, 3]. */
  const color = (psi_c, inputs, A) => mlp(psi_c, inputs, A).map(sigmoid);

  /** Eq. (3'): r = psi_r(f_a, delta_vc, d_vc) / |psi_r(...)|, [A, k, 4]. */
  const rotation = (psi_r, inputs, A) => unit(mlp(psi_r, inputs, A));

  /** Eq. (4): s = s_a * sigmoid(psi_s(f_a, delta_vc, d_vc)), [A, k, 3]. */
  function scale(psi_s, s_a, inputs, A) {
    const y = mlp(psi_s, inputs, A);
    const width = y.length / A;
    return y.map((v, i) => s_a[3 * Math.floor(i / width) + (i % 3)] * sigmoid(v));
  }

  /** Children that are drawn: those with mask 1 and alpha >= tau_alpha, as a k + child. */
  function masking(alpha, masks, tau_alpha) {
    const index = [];
    alpha.forEach((value, i) => masks[i] && value >= tau_alpha && index.push(i));
    return Int32Array.from(index);
  }

  /** Rows of an array [rows, width] by their numbers. */
  function gather(array, index, width) {
    const rows = new Float64Array(index.length * width);
    index.forEach((row, n) => rows.set(array.subarray(row * width, (row + 1) * width), n * width));
    return rows;
  }

  /** The canonical Gaussians that a camera at x_c sees: x, s, r, alpha, color, and their index. */
  function spatialPrediction(model, x_c) {
    const { header, networks, x_a, f_a, s_a, l_a, O_a, masks } = model;
    const A = x_a.length / 3;
    const { delta_vc, d_vc } = view(x_a, x_c);
    const d = f_a.length / Math.max(A, 1);
    const seen = beside(A, [f_a, d], [delta_vc, 1], [d_vc, 3]);
    const inputs = (effect) => (header.effects.includes(effect) ? seen : f_a);
    const geometry = inputs("view_geometry");
    const alpha = opacity(networks.psi_alpha, geometry, A);
    const index = masking(alpha, masks, header.tau_alpha);
    return {
      index,
      alpha: gather(alpha, index, 1),
      x: gather(offsets(x_a, O_a, l_a), index, 3),
      s: gather(scale(networks.psi_s, s_a, geometry, A), index, 3),
      r: gather(rotation(networks.psi_r, geometry, A), index, 4),
      color: gather(color(networks.psi_c, inputs("view_color"), A), index, 3),
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
   *  The last `heads` layers of psi_d stand side by side; psi_t may be empty. */
  function deformation(psi_d, psi_t, heads, x, t, { L_x, L_t, skip }) {
    const N = x.length / 3;
    let E_t = positionalEncoding([t], 1, L_t);
    if (psi_t.length) E_t = mlp(psi_t, E_t, 1);
    const [w_x, w_t] = [3 * (1 + 2 * L_x), E_t.length];
    const rows = new Float64Array(N * w_t).map((_, i) => E_t[i % w_t]);
    const inputs = beside(N, [positionalEncoding(x, 3, L_x), w_x], [rows, w_t]);
    const trunk = psi_d.slice(0, psi_d.length - heads);
    let h = inputs;
    trunk.forEach((layer, i) => {
      if (skip && i === skipOf(trunk)) h = beside(N, [inputs, w_x + w_t], [h, trunk[i - 1].J]);
      h = linear(layer, h, N, true);
    });
    return psi_d.slice(trunk.length).map((head) => linear(head, h, N, false));
  }

  const sum = (a, b) => a.map((v, i) => v + b[i]);

  /** Eq. (6): x_t = x + delta_x, s_t = s + delta_s, r_t = unit(r + delta_r). What has no delta
   *  stays as it is. */
  function deformed({ x, s, r }, { translation, scaling, rotation }) {
    return {
      x_t: translation ? sum(x, translation) : x,
      s_t: scaling ? sum(s, scaling) : s,
      r_t: rotation ? unit(sum(r, rotation)) : r,
    };
  }

  /** The Gaussians at time t: x_t, s_t, r_t. */
  function temporalPrediction(model, gaussians, t) {
    const { header, networks } = model;
    const heads = MOTION.filter((effect) => header.effects.includes(effect));
    if (heads.length === 0) return deformed(gaussians, {});
    const { psi_d, psi_t } = networks;
    const deltas = deformation(psi_d, psi_t, heads.length, gaussians.x, t, header);
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

  /** Sigma = R(r) diag(s)^2 R(r)^T, [N, 3, 3]. */
  function covariance(s, r) {
    const Sigma = new Float64Array(3 * s.length);
    for (let n = 0; n < s.length / 3; n++) {
      const M = rotationMatrix(r[4 * n], r[4 * n + 1], r[4 * n + 2], r[4 * n + 3]);
      for (let j = 0; j < 3; j++) for (const row of M) row[j] *= s[3 * n + j];
      for (let i = 0; i < 3; i++) {
        for (let j = 0; j < 3; j++) {
          const product = M[i][0] * M[j][0] + M[i][1] * M[j][1] + M[i][2] * M[j][2];
          Sigma[9 * n + 3 * i + j] = product;
        }
      }
    }
    return Sigma;
  }

  /** Sigma_2D = J W Sigma W^T J^T + 0.3 I, its inverse `conic`, both as (a, b, c); mean2d, depth.
   *  What is not visible has zeros everywhere. */
  function projection(x, Sigma, { W, T, focal, center, size }) {
    const N = x.length / 3;
    const [mean2d, depth] = [new Float64Array(2 * N), new Float64Array(N)];
    const [cov2d, conic] = [new Float64Array(3 * N), new Float64Array(3 * N)];
    const visible = new Uint8Array(N);
    const [limit_x, limit_y] = [0, 1].map((i) => (1.3 * size[i]) / (2 * focal[i]));
    for (let n = 0; n < N; n++) {
      const [p, q, o] = [x[3 * n], x[3 * n + 1], x[3 * n + 2]];
      const X = W[0] * p + W[1] * q + W[2] * o + T[0];
      const Y = W[3] * p + W[4] * q + W[5] * o + T[1];
      const z = W[6] * p + W[7] * q + W[8] * o + T[2];
      if (!(z > 0.2) || !Number.isFinite(X + Y + z)) continue;
      const g = clip(X / z, -limit_x, limit_x);
      const h = clip(Y / z, -limit_y, limit_y);
      const [j_x, j_y] = [focal[0] / z, focal[1] / z];
      const V = new Float64Array(6); // J W, its two rows
      for (let i = 0; i < 3; i++) {
        V[i] = j_x * (W[i] - g * W[6 + i]);
        V[3 + i] = j_y * (W[3 + i] - h * W[6 + i]);
      }
      let [a, b, c] = [0.3, 0, 0.3];
      for (let i = 0; i < 3; i++) {
        const at = 9 * n + 3 * i;
        const u = Sigma[at] * V[0] + Sigma[at + 1] * V[1] + Sigma[at + 2] * V[2];
        const v = Sigma[at] * V[3] + Sigma[at + 1] * V[4] + Sigma[at + 2] * V[5];
        a += V[i] * u;
        b += V[i] * v;
        c += V[3 + i] * v;
      }
      const determinant = a * c - b * b;
      if (!(determinant > 0) || !Number.isFinite(determinant)) continue;
      visible[n] = 1;
      depth[n] = z;
      mean2d.set([j_x * X + center[0], j_y * Y + center[1]], 2 * n);
      cov2d.set([a, b, c], 3 * n);
      conic.set([c / determinant, -b / determinant, a / determinant], 3 * n);
    }
    return { mean2d, cov2d, conic, depth, visible };
  }

  // --- the picture ------------------------------------------------------------------------------
  /** C = sum_i c_i o_i T_i + T_N background with o = min(alpha_max, alpha exp(...)), [H, W, 3].
   *
   *  Nothing is left out where `least` is 0. Otherwise every Gaussian is drawn within the ellipse
   *  in which o >= least: 5e-5 cannot be seen, 1e-13 is as exact as doubles are. */
  function compositing(splats, { background, size, occlusion, alpha_max = 0.99, least = 0 }) {
    const { mean2d, conic, alpha, color, depth, visible } = splats;
    const [width, height] = size;
    const image = new Float64Array(3 * width * height);
    const transmittance = new Float64Array(width * height).fill(1);
    const order = Array.from(depth.keys()).filter((n) => visible[n]);
    order.sort((i, j) => depth[i] - depth[j] || i - j); // the nearest first
    for (const n of order) {
      const [A, B, C] = conic.subarray(3 * n, 3 * n + 3);
      const [u_0, v_0, opaque] = [mean2d[2 * n], mean2d[2 * n + 1], alpha[n]];
      const [red, green, blue] = color.subarray(3 * n, 3 * n + 3);
      // alpha exp(-E) >= least where 2 E <= reach; the determinant of the conic gives the rows.
      const reach = least > 0 ? 2 * Math.log(Math.abs(opaque) / least) : Infinity;
      if (!(reach > 0)) continue;
      const determinant = A * C - B * B;
      const tall = least > 0 ? Math.sqrt((reach * A) / determinant) : Infinity;
      const top = Math.max(0, Math.ceil(v_0 - tall));
      const bottom = Math.min(height - 1, Math.floor(v_0 + tall));
      for (let v = top; v <= bottom; v++) {
        const e_2 = v - v_0;
        const wide = Math.sqrt(Math.max(reach * A - determinant * e_2 * e_2, 0)) / A;
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
  const centreOf = ({ W, T }) =>
    [0, 1, 2].map((i) => -(W[i] * T[0] + W[3 + i] * T[1] + W[6 + i] * T[2]));

  /** The splats of Gaussians at time t. */
  function splatting(gaussians, { x_t, s_t, r_t }, camera) {
    const { alpha, color } = gaussians;
    return { ...projection(x_t, covariance(s_t, r_t), camera), alpha, color };
  }

  /** The picture of a model, [height, width, 3], red, green and blue from 0 to 1. */
  function render(model, camera, t, { least = 0 } = {}) {
    const { header } = model;
    const gaussians = spatialPrediction(model, centreOf(camera));
    const splats = splatting(gaussians, temporalPrediction(model, gaussians, t), camera);
    const occlusion = header.effects.includes("occlusion");
    const scene = { background: header.background, size: camera.size, occlusion, least };
    return compositing(splats, scene).image.map((value) => clip(value, 0, 1));
  }

  Object.assign(exported, { Refused, decode, openContainer, hashFeature, layersOf });
  Object.assign(exported, { hashRow, roundHalfEven, mlp, sigmoid, unit, offsets, view, opacity });
  Object.assign(exported, { color, rotation, scale, masking, gather, beside, positionalEncoding });
  Object.assign(exported, { deformation, deformed, rotationMatrix, covariance, projection });
  Object.assign(exported, { compositing, spatialPrediction, temporalPrediction, splatting });
  /** The frequency table of a Gaussian, for the price of a symbol. */
  function gaussianTable(mu_units, sigma_units) {
    const table = new GaussianTable().set(mu_units, sigma_units);
    return { first: table.c - table.W, n: table.n, low: table.low, cum: (j) => table.cum(j) };
  }

  Object.assign(exported, { render, centreOf, gaussianTable, TABLES });
})(typeof module === "object" ? module.exports : (globalThis.p4dgs = {}));
