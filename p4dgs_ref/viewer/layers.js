// What can be drawn above a picture: anchors with children, ellipses, motion, paths, the grid.
//
// A frame is what was drawn: {model, camera, t, gaussians, moved, splats, selected, level}.
// A layer returns a note about itself, or null.
// Every line except those of paths has a light edge, so that it shows on any background.
"use strict";

(function (exported) {
  const { p4dgs, draw } = globalThis;

  const TIMES = 25; // of a path
  const MOST_PATHS = 400;
  const MOST_MOTIONS = 250;
  const MOST_PRODUCTS = 2 ** 31; // multiplications for all paths
  const MOST_LINES = 33; // of a grid, along an axis
  const SURFACE = 128; // pixels along a side of the picture of depths
  const AXES = "xyz";
  const INK = { dark: "#14202e", motion: "#b3420a", cell: "#0b4f8a" };
  const MARKED = "#8000d0"; // the colour of the anchor that the guide and the tutorials follow

  // --- drawing ----------------------------------------------------------------------------------
  /** Strokes a path with a light edge. */
  function stroke(context, path, color, width = 1.3) {
    context.lineWidth = width + 1.6;
    context.strokeStyle = "rgb(255 255 255 / 0.75)";
    context.stroke(path);
    context.lineWidth = width;
    context.strokeStyle = color;
    context.stroke(path);
  }

  function fill(context, path, color) {
    context.lineWidth = 1.6;
    context.strokeStyle = "rgb(255 255 255 / 0.9)";
    context.stroke(path);
    context.fillStyle = color;
    context.fill(path);
  }

  function circle(path, [u, v], radius) {
    path.moveTo(u + radius, v);
    path.arc(u, v, radius, 0, 2 * Math.PI);
  }

  function line(path, from, to) {
    if (!from || !to) return;
    path.moveTo(...from);
    path.lineTo(...to);
  }

  /** Where a point of the world is on the stage, in its pixels; null behind the camera. */
  function place({ camera, scale }, x, y, z) {
    const { W, T, focal, center } = camera;
    const depth = W[6] * x + W[7] * y + W[8] * z + T[2];
    if (!(depth > 0.01)) return null;
    const u = (focal[0] * (W[0] * x + W[1] * y + W[2] * z + T[0])) / depth + center[0];
    const v = (focal[1] * (W[3] * x + W[4] * y + W[5] * z + T[1])) / depth + center[1];
    const at = [(u + 0.5) * scale, (v + 0.5) * scale];
    return at.every((value) => Math.abs(value) < 1e5) ? at : null;
  }

  /** The same for row n of an array [N, 3]. */
  const placeRow = (frame, x, n) => place(frame, x[3 * n], x[3 * n + 1], x[3 * n + 2]);

  /** Where the centre of splat n is; null where it is not visible. */
  function centreOfSplat({ splats, scale }, n) {
    const at = [0, 1].map((i) => (splats.mean2d[2 * n + i] + 0.5) * scale);
    return splats.visible[n] && at.every((v) => Math.abs(v) < 1e5) ? at : null;
  }

  /** Adds the ellipse of one standard deviation of splat n. */
  function ellipse(path, frame, n) {
    const { splats, scale } = frame;
    const at = centreOfSplat(frame, n);
    if (!at) return;
    const [a, b, c] = splats.cov2d.subarray(3 * n, 3 * n + 3);
    const [middle, half] = [(a + c) / 2, Math.hypot((a - c) / 2, b)];
    const axis = (square) => scale * Math.sqrt(Math.max(square, 0));
    const [long, short] = [axis(middle + half), axis(middle - half)];
    if (!(long < 4000)) return;
    const angle = Math.atan2(2 * b, a - c) / 2;
    path.moveTo(at[0] + long * Math.cos(angle), at[1] + long * Math.sin(angle));
    path.ellipse(...at, long, short, angle, 0, 2 * Math.PI);
  }

  // --- the layers -------------------------------------------------------------------------------
  /** Whether a splat is behind the surface of the scene: its depth is composited in the place of a
   *  colour, with few pixels. */
  function behindSurface({ model, camera, moved, gaussians }) {
    const shrink = (values) => values.map((v) => (v * SURFACE) / camera.size[0]);
    const small = { ...camera, size: [SURFACE, SURFACE] };
    Object.assign(small, { focal: shrink(camera.focal), center: shrink(camera.center) });
    const splats = p4dgs.splatting(gaussians, moved, small);
    const color = new Float64Array(3 * splats.depth.length);
    splats.depth.forEach((depth, n) => color.set([depth, 1, 0], 3 * n));
    const scene = draw.settings(model, small, [0, 0, 0]);
    const { image } = p4dgs.compositing({ ...splats, color }, scene);
    const near = 0.03 * Math.hypot(...model.hi.map((v, i) => v - model.lo[i]));
    return (n) => {
      const [u, v] = [0, 1].map((i) => Math.round(splats.mean2d[2 * n + i]));
      if (u < 0 || v < 0 || u >= SURFACE || v >= SURFACE) return false;
      const [sum, weight] = image.slice(3 * (v * SURFACE + u), 3 * (v * SURFACE + u) + 2);
      return weight > 0.5 && splats.depth[n] > sum / weight + near;
    };
  }

  /** Squares at anchors, and lines to dots at those children that are drawn, but nothing behind a
   *  surface: faint, and strong for the selected anchor. */
  function families(context, frame) {
    const { model, gaussians, selected } = frame;
    const isBehind = behindSurface(frame);
    for (const isMarked of [false, true]) {
      const [lines, dots, squares] = [new Path2D(), new Path2D(), new Path2D()];
      gaussians.index.forEach((child, n) => {
        const a = Math.floor(child / model.header.k);
        const [from, to] = [placeRow(frame, model.x_a, a), centreOfSplat(frame, n)];
        if ((a === selected) !== isMarked || !from || !to || isBehind(n)) return;
        line(lines, from, to);
        circle(dots, to, isMarked ? 4 : 2);
        squares.rect(from[0] - 2.5, from[1] - 2.5, 5, 5);
      });
      context.globalAlpha = isMarked ? 1 : 0.4;
      stroke(context, lines, isMarked ? MARKED : INK.cell, isMarked ? 2 : 0.8);
      fill(context, dots, isMarked ? MARKED : INK.cell);
      fill(context, squares, INK.dark);
    }
  }

  function ellipses(context, frame) {
    const path = new Path2D();
    frame.gaussians.index.forEach((_, n) => ellipse(path, frame, n));
    stroke(context, path, INK.dark, 0.8);
  }

  /** A ring where a child is canonical, a dot where it is at time t, and a line between. */
  function motion(context, frame) {
    const { gaussians } = frame;
    const [lines, rings, dots] = [new Path2D(), new Path2D(), new Path2D()];
    const stride = Math.ceil(gaussians.index.length / MOST_MOTIONS);
    for (let n = 0; n < gaussians.index.length; n += stride) {
      const [from, to] = [placeRow(frame, gaussians.x, n), placeRow(frame, frame.moved.x_t, n)];
      if (!from || !to || Math.hypot(from[0] - to[0], from[1] - to[1]) < 2) continue;
      line(lines, from, to);
      circle(rings, from, 2.5);
      circle(dots, to, 2);
    }
    stroke(context, lines, INK.motion, 1);
    stroke(context, rings, INK.motion, 1);
    fill(context, dots, INK.motion);
    return stride > 1 ? `Motion of one child in ${stride}.` : null;
  }

  let known = {};

  /** The children of a model that a mask keeps, also those below tau_alpha. */
  function kept(model, camera) {
    const header = { ...model.header, tau_alpha: -Infinity };
    return p4dgs.spatialPrediction({ ...model, header }, p4dgs.centreOf(camera));
  }

  /** The paths of some children over all times, {count, all, steps}, each step [count, 3]. Their
   *  canonical positions, and so the paths, do not depend on the camera. */
  function pathsOf(model, camera) {
    if (known.model === model) return known;
    const gaussians = kept(model, camera);
    const heads = Math.max(1, draw.products(model.networks.psi_d));
    const N = gaussians.index.length;
    const most = Math.floor(MOST_PRODUCTS / heads / TIMES);
    const count = Math.min(N, MOST_PATHS, most);
    const chosen = Int32Array.from({ length: count }, (_, i) => Math.floor((i * N) / count));
    const rows = { x: p4dgs.gather(gaussians.x, chosen, 3) };
    rows.s = p4dgs.gather(gaussians.s, chosen, 3);
    rows.r = p4dgs.gather(gaussians.r, chosen, 4);
    const time = (_, i) => draw.deform(model, rows, i / (TIMES - 1)).x_t;
    known = { model, count, all: N, steps: Array.from({ length: TIMES }, time) };
    return known;
  }

  /** Lines from time 0 (thin, dark, on top) to time 1 (thick, light); a dot ends each. */
  function paths(context, frame) {
    const { count, all, steps } = pathsOf(frame.model, frame.camera);
    for (let i = TIMES - 1; i > 0; i--) {
      const path = new Path2D();
      for (let n = 0; n < count; n++) {
        line(path, placeRow(frame, steps[i - 1], n), placeRow(frame, steps[i], n));
      }
      context.lineWidth = 0.8 + (3 * i) / TIMES;
      context.strokeStyle = draw.css(i / (TIMES - 1));
      context.stroke(path);
    }
    const ends = new Path2D();
    for (let n = 0; n < count; n++) {
      const [start, end] = [placeRow(frame, steps[0], n), placeRow(frame, steps[TIMES - 1], n)];
      const far = (at) => at && Math.hypot(at[0] - start[0], at[1] - start[1]) > 3;
      const moves = start && end && steps.some((step) => far(placeRow(frame, step, n)));
      if (moves) circle(ends, end, 2);
    }
    fill(context, ends, INK.dark);
    return count < all ? `Paths of ${count} of ${all} children.` : null;
  }

  // --- the hash grid ----------------------------------------------------------------------------
  const corner = ({ lo, hi }, shares) => shares.map((share, i) => lo[i] + share * (hi[i] - lo[i]));

  /** One of how many nodes is drawn. */
  const every = (R) => Math.ceil((R - 1) / (MOST_LINES - 1)) || 1;

  /** Level `level` of the grid: its axes, R nodes along each, and where its signs begin. */
  function levelOf({ header }, level) {
    const [names, R] = header.grid[level];
    const before = header.grid.slice(0, level).map((one) => p4dgs.nodesOf(header, one));
    const first = header.F * before.reduce((sum, count) => sum + count, 0);
    const T = p4dgs.nodesOf(header, [names, R]);
    return { axes: [...names].map((name) => AXES.indexOf(name)), R, first, T };
  }

  /** Where node `n` is on the stage: three numbers from 0 to R - 1. */
  const placeNode = (frame, { R }, n) =>
    place(frame, ...corner(frame.model, n.map((i) => (R > 1 ? i / (R - 1) : 0))));

  /** 1 for a plus, 0 for a minus: the first of the F signs of a node. */
  const signOf = ({ model }, { axes, R, first, T }, n) =>
    model.signs[first + model.header.F * p4dgs.hashRow(axes.map((axis) => n[axis]), R, T)];

  /** Along each axis the nodes before and behind the selected anchor; the first one without it. */
  function cellOf({ model, selected }, { axes, R }) {
    return [0, 1, 2].map((axis) => {
      if (selected === null || !axes.includes(axis)) return [0, 0];
      const at = Math.floor((model.positions[3 * selected + axis] / 65535) * (R - 1));
      const base = Math.min(at, Math.max(R - 2, 0));
      return [base, Math.min(base + 1, R - 1)];
    });
  }

  /** The nodes of the chosen level with their signs, in planes through the selected anchor's cell,
   *  and this cell. */
  function grid(context, frame) {
    const level = levelOf(frame.model, frame.level);
    const { axes, R } = level;
    const [path, thick, dots] = [new Path2D(), new Path2D(), [new Path2D(), new Path2D()]];
    const join = (to, ...ends) => line(to, ...ends.map((n) => placeNode(frame, level, n)));
    const sign = (n, radius) => {
      const at = placeNode(frame, level, n);
      if (at) circle(dots[signOf(frame, level, n)], at, radius);
    };
    const cell = cellOf(frame, level);
    const count = Math.ceil((R - 1) / every(R)) + 1;
    const drawn = Array.from({ length: count }, (_, i) => Math.min(i * every(R), R - 1));
    for (const [a, b] of axes.length === 2 ? [axes] : [[0, 1], [0, 2], [1, 2]]) {
      const node = (i, j) => cell.map(([at], axis) => (axis === a ? i : axis === b ? j : at));
      for (const i of drawn) {
        join(path, node(i, 0), node(i, R - 1));
        join(path, node(0, i), node(R - 1, i));
        for (const j of drawn) sign(node(i, j), 2.2);
      }
    }
    for (let from = 0; from < 8 && frame.selected !== null; from++) {
      const node = (bits) => cell.map((ends, axis) => ends[(bits >> axis) & 1]);
      sign(node(from), 4);
      for (const bit of [1, 2, 4]) if (!(from & bit)) join(thick, node(from), node(from | bit));
    }
    stroke(context, path, INK.cell, 0.7);
    stroke(context, thick, INK.cell, 2.2);
    context.lineWidth = 3;
    context.strokeStyle = INK.dark;
    context.stroke(dots[0]); // a dark edge, so that white is seen on white
    fill(context, dots[0], "#fff");
    fill(context, dots[1], INK.dark);
    return every(R) > 1 ? `Only one line in ${every(R)} is drawn.` : null;
  }

  /** The nodes that the selected anchor reads at a level, [{at, share}], the largest share first.
   *  The F signs of a node begin `at`. */
  function nodesRead({ model, selected, level }) {
    const { axes, R, first, T } = levelOf(model, level);
    const place = axes.map((axis) => (model.positions[3 * selected + axis] / 65535) * (R - 1));
    const nodes = Array.from({ length: 2 ** axes.length }, (_, from) => {
      const upper = axes.map((_, i) => (from >> i) & 1);
      const node = place.map((v, i) => Math.min(Math.floor(v) + upper[i], R - 1));
      const share = place.reduce((all, v, i) => all * (upper[i] ? v % 1 : 1 - (v % 1)), 1);
      return { at: first + model.header.F * p4dgs.hashRow(node, R, T), share };
    });
    return nodes.sort((one, other) => other.share - one.share);
  }

  // --- the selected anchor ----------------------------------------------------------------------
  /** A ring around the anchor, and lines to its children with their ellipses. */
  function selection(context, frame) {
    const { model, gaussians, selected } = frame;
    const at = selected === null ? null : placeRow(frame, model.x_a, selected);
    if (!at) return;
    const path = new Path2D();
    gaussians.index.forEach((child, n) => {
      if (Math.floor(child / model.header.k) !== selected) return;
      ellipse(path, frame, n);
      line(path, at, centreOfSplat(frame, n));
    });
    stroke(context, path, MARKED, 1.6);
    const ring = new Path2D();
    circle(ring, at, 8);
    stroke(context, ring, MARKED, 2.4);
  }

  /** A square around a chosen pixel. */
  function pixel(context, [u, v]) {
    const path = new Path2D();
    path.rect(u - 5, v - 5, 10, 10);
    stroke(context, path, MARKED, 2.4);
  }

  /** The anchor nearest to a point of the stage, or null where none is within `reach` pixels. */
  function nearest(frame, u, v, reach = 18) {
    let [found, least] = [null, reach];
    for (let a = 0; a < frame.model.header.anchors; a++) {
      const at = placeRow(frame, frame.model.x_a, a);
      const distance = at ? Math.hypot(at[0] - u, at[1] - v) : Infinity;
      if (distance < least) [found, least] = [a, distance];
    }
    return found;
  }

  const LAYERS = { grid, ellipses, paths, motion, families };
  Object.assign(exported, { LAYERS, behindSurface, selection, pixel, nearest, nodesRead, kept });
})((globalThis.layers = {}));
