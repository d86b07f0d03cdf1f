// Answers the oracle's checker for the port in p4dgs.js, in the protocol of the vectors' page:
//
//     p4dgs-ref oracle check --adapter "node p4dgs_ref/viewer/adapter.js"
//
// Its first line says what the port lacks: it has no backward functions, and no training.
"use strict";

const readline = require("readline");
const p4dgs = require("./p4dgs.js");

const TYPES = {
  F64: Float64Array,
  F32: Float32Array,
  I64: BigInt64Array,
  I32: Int32Array,
  U16: Uint16Array,
  U8: Uint8Array,
  BOOL: Uint8Array,
};
let floats = "F64";

/** An ARRAY as {shape, data}; all numbers are doubles. */
function unpacked({ dtype, shape, data }) {
  const bytes = Uint8Array.from(Buffer.from(data, "base64"));
  return { shape, data: Float64Array.from(new TYPES[dtype](bytes.buffer), Number) };
}

function packed(dtype, shape, numbers) {
  const array = TYPES[dtype].from(numbers, dtype === "I64" ? (v) => BigInt(v) : (v) => v);
  const data = Buffer.from(array.buffer, array.byteOffset, array.byteLength).toString("base64");
  return { dtype, shape, data };
}

const real = (shape, numbers) => packed(floats, shape, numbers);
const whole = (shape, numbers) => packed("I64", shape, numbers);

/** The layers of a network from the tensors <prefix>weights.0, <prefix>biases.0, ... */
function network(tensors, prefix = "") {
  const layers = [];
  while (tensors[`${prefix}weights.${layers.length}`]) {
    const { shape, data } = tensors[`${prefix}weights.${layers.length}`];
    const b = tensors[`${prefix}biases.${layers.length}`].data;
    layers.push({ I: shape[0], J: shape[1], W: data, b });
  }
  return layers;
}

/** The inputs (f_a, delta_vc, d_vc) of an anchor network, and their number of rows. */
function anchorInputs({ f_a, delta_vc, d_vc }) {
  const parts = [f_a, delta_vc, d_vc].map(({ shape, data }) => [data, shape[1]]);
  return [p4dgs.beside(f_a.shape[0], ...parts), f_a.shape[0]];
}

/** What an anchor network predicts of every child, [A, k] or [A, k, width]. */
function predicted(compute, tensors, ...width) {
  const [layers, [inputs, A]] = [network(tensors), anchorInputs(tensors)];
  const k = layers.at(-1).J / (width[0] ?? 1);
  return real([A, k, ...width], compute(layers, inputs, A));
}

function cameraOf({ W, T, focal, center, size }) {
  const camera = { W, T, focal, center, size };
  return Object.fromEntries(Object.entries(camera).map(([name, { data }]) => [name, data]));
}

/** A model as `spatialPrediction` reads it. A head that a case lacks has no effect. */
function modelOf(tensors, settings) {
  const data = (name) => tensors[name].data;
  const networks = {};
  for (const name of ["psi_alpha", "psi_c", "psi_r", "psi_s", "psi_d"]) {
    networks[name] = network(tensors, `${name}_`);
  }
  const model = { networks, header: settings, masks: data("mask") };
  for (const name of ["x_a", "f_a", "s_a", "l_a", "O_a"]) model[name] = data(name);
  return model;
}

/** Heads of width 0 stand for effects that are off. */
function deltasOf(tensors, named) {
  const deltas = {};
  for (const [effect, name] of Object.entries(named)) {
    if (tensors[name].shape[1] > 0) deltas[effect] = tensors[name].data;
  }
  return deltas;
}

function projected({ mean2d, cov2d, conic, depth, visible }, N) {
  return {
    mean2d: real([N, 2], mean2d),
    cov2d: real([N, 3], cov2d),
    conic: real([N, 3], conic),
    depth: real([N], depth),
    visible: packed("BOOL", [N], visible),
  };
}

function rounded({ f, q }) {
  const symbols = f.data.map((v, i) => p4dgs.roundHalfEven(v / q.data[Math.floor(i / f.shape[1])]));
  const f_hat = symbols.map((n, i) => n * q.data[Math.floor(i / f.shape[1])]);
  return { symbols: whole(f.shape, symbols), f_hat: real(f.shape, f_hat) };
}

function moved(gaussians, { x_t, s_t, r_t }) {
  const N = gaussians.x.length / 3;
  return { x_t: real([N, 3], x_t), s_t: real([N, 3], s_t), r_t: real([N, 4], r_t) };
}

/** The image of a model before a case's camera, at its time. */
function drawn(model, tensors, { t }) {
  const camera = cameraOf(tensors);
  const [width, height] = camera.size;
  return { image: real([height, width, 3], p4dgs.render(model, camera, t)) };
}

/** What the port computes of every subject that it has: outputs from tensors and settings. */
const PORT = {
  tanh: ({ y }) => ({ alpha: real(y.shape, y.data.map(Math.tanh)) }),
  sigmoid: ({ y }) => ({ color: real([y.shape[0], 1, y.shape[1]], y.data.map(p4dgs.sigmoid)) }),
  unit_quaternion: ({ y }) => ({ r: real([y.shape[0], 1, 4], p4dgs.unit(y.data)) }),
  waves: ({ p }, { L }) => PORT.positional_encoding({ p }, { L }),
  positional_encoding({ p }, { L }) {
    const [N, D] = p.shape;
    return { E: real([N, D * (1 + 2 * L)], p4dgs.positionalEncoding(p.data, D, L)) };
  },
  rotation_matrix({ r }) {
    const rows = Array.from({ length: r.shape[0] }, (_, n) => r.data.subarray(4 * n, 4 * n + 4));
    const R = rows.flatMap((row) => p4dgs.rotationMatrix(...row).flat());
    return { R: real([rows.length, 3, 3], R) };
  },
  hash_index({ corner }, { res, table }) {
    const [n, D] = corner.shape;
    const row = (_, i) => p4dgs.hashRow(corner.data.subarray(i * D, (i + 1) * D), res, table);
    return { row: whole([n], Array.from({ length: n }, row)) };
  },
  rounding: rounded,
  rounding_ties: rounded,
  mlp(tensors) {
    const [layers, N] = [network(tensors), tensors.x.shape[0]];
    return { y: real([N, layers.at(-1).J], p4dgs.mlp(layers, tensors.x.data, N)) };
  },
  view({ x_a, x_c }) {
    const { delta_vc, d_vc } = p4dgs.view(x_a.data, x_c.data);
    return { delta_vc: real([x_a.shape[0], 1], delta_vc), d_vc: real(x_a.shape, d_vc) };
  },
  offsets: ({ x_a, O_a, l_a }) => ({
    x: real(O_a.shape, p4dgs.offsets(x_a.data, O_a.data, l_a.data)),
  }),
  opacity: (tensors) => ({ alpha: predicted(p4dgs.opacity, tensors) }),
  color: (tensors) => ({ color: predicted(p4dgs.color, tensors, 3) }),
  rotation: (tensors) => ({ r: predicted(p4dgs.rotation, tensors, 4) }),
  scale(tensors) {
    const scale = (layers, ...inputs) => p4dgs.scale(layers, tensors.s_a.data, ...inputs);
    return { s: predicted(scale, tensors, 3) };
  },
  masking(tensors, { tau_alpha }) {
    const index = p4dgs.masking(tensors.alpha.data, tensors.mask.data, tau_alpha);
    const [N, out] = [index.length, { index: whole([index.length], index) }];
    for (const [name, width] of Object.entries({ x: 3, color: 3, s: 3, r: 4 })) {
      out[name] = real([N, width], p4dgs.gather(tensors[name].data, index, width));
    }
    return { ...out, alpha: real([N], p4dgs.gather(tensors.alpha.data, index, 1)) };
  },
  deformation(tensors, { t, L_x, L_t }) {
    const [layers, { x }] = [network(tensors), tensors];
    const deltas = p4dgs.deformation(layers, 3, x.data, t, { L_x, L_t });
    const names = ["delta_x", "delta_s", "delta_r"];
    const head = (i) => real([x.shape[0], layers.at(i - 3).J], deltas[i]);
    return Object.fromEntries(names.map((name, i) => [name, head(i)]));
  },
  deformed(tensors) {
    const names = { translation: "delta_x", scaling: "delta_s", rotation: "delta_r" };
    const gaussians = { x: tensors.x.data, s: tensors.s.data, r: tensors.r.data };
    return moved(gaussians, p4dgs.deformed(gaussians, deltasOf(tensors, names)));
  },
  covariance: ({ s, r }) => ({
    Sigma: real([s.shape[0], 3, 3], p4dgs.covariance(s.data, r.data)),
  }),
  projection: (tensors) =>
    projected(
      p4dgs.projection(tensors.x.data, { Sigma: tensors.Sigma.data }, cameraOf(tensors)),
      tensors.x.shape[0],
    ),
  pixel(tensors) {
    const N = tensors.x.shape[0];
    const Sigma = { data: new Float64Array(9 * N) };
    const { mean2d, depth, visible } = PORT.projection({ ...tensors, Sigma });
    return { mean2d, depth, visible };
  },
  compositing(tensors, { height, width, occlusion = true, alpha_max = 0.99 }) {
    const data = Object.fromEntries(Object.entries(tensors).map(([name, a]) => [name, a.data]));
    const scene = { background: data.background, size: [width, height], occlusion, alpha_max };
    const { image, transmittance } = p4dgs.compositing(data, scene);
    return {
      image: real([height, width, 3], image),
      transmittance: real([height, width], transmittance),
    };
  },
  spatial_prediction(tensors, settings) {
    const found = p4dgs.spatialPrediction(modelOf(tensors, settings), tensors.x_c.data);
    const N = found.index.length;
    const out = { index: whole([N], found.index), alpha: real([N], found.alpha) };
    const widths = { x: 3, s: 3, r: 4, color: 3 };
    for (const [name, w] of Object.entries(widths)) out[name] = real([N, w], found[name]);
    return out;
  },
  temporal_prediction(tensors, settings) {
    const gaussians = { x: tensors.x.data, s: tensors.s.data, r: tensors.r.data };
    const layers = network(tensors, "psi_d_");
    const all = ["translation", "scaling", "rotation"];
    const effects = all.filter((_, i) => layers.at(i - 3).J > 0);
    const model = {
      header: { effects, ...settings },
      networks: { psi_d: layers.filter(({ J }) => J > 0) },
    };
    return moved(gaussians, p4dgs.temporalPrediction(model, gaussians, settings.t));
  },
  projection_stage(tensors) {
    const [x, s, r] = ["x", "s", "r"].map((name) => tensors[name].data);
    const found = p4dgs.projection(x, { M: p4dgs.root(s, r) }, cameraOf(tensors));
    const { mean2d, conic, depth, visible } = projected(found, tensors.x.shape[0]);
    return { mean2d, conic, depth, visible };
  },
  compositing_stage(tensors, { occlusion = true }) {
    const [x_t, s_t, r_t] = ["x", "s", "r"].map((name) => tensors[name].data);
    const gaussians = { alpha: tensors.alpha.data, color: tensors.color.data };
    const camera = cameraOf(tensors);
    const splats = p4dgs.splatting(gaussians, { x_t, s_t, r_t }, camera);
    const scene = { background: tensors.background.data, size: camera.size, occlusion };
    const [width, height] = camera.size;
    return { image: real([height, width, 3], p4dgs.compositing(splats, scene).image) };
  },
  frames(tensors, settings) {
    if (settings.renderer !== "exact") return { skip: `no renderer "${settings.renderer}"` };
    const model = modelOf(tensors, { ...settings, background: tensors.background.data });
    return drawn(model, tensors, settings);
  },
  pictures: (tensors, settings) =>
    drawn(p4dgs.decode(Uint8Array.from(tensors.stream.data)), tensors, settings),
};

/** The arrays of a decoded file, as the vectors' page describes them. */
function arraysOf(model) {
  const { header, groups, columns } = model;
  const [A, k] = [header.anchors, header.k];
  const H = header.F * header.grid.length;
  const h = new Float64Array(A * H);
  for (let a = 0; a < A; a++) p4dgs.hashFeature(model, a, h.subarray(a * H, (a + 1) * H));
  const attributes = p4dgs.beside(A, ...groups.map(({ name, width }) => [model[name], width]));
  const arrays = {
    positions: packed("U16", [A, 3], model.positions),
    x_a: packed("F64", [A, 3], model.x_a),
    masks: packed("U8", [A, k], model.masks),
    signs: packed("BOOL", [model.signs.length], model.signs),
    h: packed("I32", [A, H], h),
    q_units: packed("I32", [A, 4], model.q_units),
    q: packed("F64", [A, 4], model.q),
    mu_units: packed("I64", [A, columns], model.mu_units),
    sigma_units: packed("I32", [A, columns], model.sigma_units),
    symbols: packed("I64", [A, columns], model.symbols),
    attributes: packed("F64", [A, columns], attributes),
  };
  for (const [section, names] of Object.entries(p4dgs.NETWORKS)) {
    if (!(section in model.bytes)) continue;
    const layers = names.flatMap((name) => model.networks[name]);
    const numbers = layers.flatMap(({ W, b }) => [...W, ...b]);
    arrays[section] = packed("F32", [numbers.length], numbers);
  }
  return arrays;
}

function answerTo(request) {
  if ("p4dgs_oracle" in request) {
    floats = request.dtype === "float32" ? "F32" : "F64";
    return { p4dgs_oracle: 1, gradients: false, subjects: [...Object.keys(PORT), "codec"] };
  }
  if ("stream" in request) {
    try {
      const model = p4dgs.decode(new Uint8Array(Buffer.from(request.stream, "base64")));
      return { arrays: arraysOf(model) };
    } catch (error) {
      if (!(error instanceof p4dgs.Refused)) throw error;
      const { section, offset, kind } = error;
      return { refused: error.message, section, offset, kind };
    }
  }
  const tensors = Object.entries(request.in).map(([name, array]) => [name, unpacked(array)]);
  const out = PORT[request.subject](Object.fromEntries(tensors), request.settings);
  return out.skip ? out : { out };
}

readline.createInterface({ input: process.stdin }).on("line", (line) => {
  const request = JSON.parse(line);
  let answer = null;
  try {
    answer = answerTo(request);
  } catch (error) {
    answer = { error: String(error.stack) };
  }
  process.stdout.write(`${JSON.stringify({ id: request.id, ...answer })}\n`);
});
