// Pictures of a model, for a page that draws many of them: on a canvas, or by WebGL2.
//
// Both paths take the same splats, which p4dgs.js computes. The canvas path is p4dgs.compositing
// with ellipses that end where nothing can be seen; WebGL2 draws one quad for every ellipse, the
// farthest first, and blends them in 16-bit floats.
"use strict";

(function (exported) {
  const p4dgs = typeof module === "object" ? require("./p4dgs.js") : globalThis.p4dgs;

  const LEAST = 5e-5; // an opacity below it is not drawn
  const ALPHA_MAX = 0.99;
  const ROWS = 1024; // Gaussians that are deformed at once: their numbers stay in a fast cache

  // --- what a page takes on ---------------------------------------------------------------------
  const MOST = 2 ** 18; // Gaussians

  /** Why a sound file is too large for this page, or null. */
  function tooLarge({ header: { anchors, k } }) {
    const [count, most] = [anchors * k, MOST].map((number) => number.toLocaleString("en"));
    return anchors * k > MOST ? `${count} Gaussians; this page shows at most ${most}` : null;
  }

  const products = (layers) => layers.reduce((sum, { I, J }) => sum + I * J, 0);

  // --- from a model to splats -------------------------------------------------------------------
  /** Eqs. (5) and (6) for all Gaussians, a block of rows at a time. */
  function deform(model, { x, s, r }, t) {
    const all = { x_t: new Float64Array(x.length), s_t: s.slice(), r_t: r.slice() };
    for (let row = 0; row < x.length / 3; row += ROWS) {
      const block = (array, width) => array.subarray(width * row, width * (row + ROWS));
      const canonical = { x: block(x, 3), s: block(s, 3), r: block(r, 4) };
      const { x_t, s_t, r_t } = p4dgs.temporalPrediction(model, canonical, t);
      all.x_t.set(x_t, 3 * row);
      all.s_t.set(s_t, 3 * row);
      all.r_t.set(r_t, 4 * row);
    }
    return all;
  }

  const seen = new WeakMap(); // of each model what was computed last

  /** What a camera sees at time t: Gaussians (Eqs. 1 to 4), moved (5 and 6), and their splats.
   *  `canonical` leaves out the motion. */
  function see(model, camera, t, { canonical = false } = {}) {
    const last = seen.get(model) ?? {};
    const x_c = p4dgs.centreOf(camera);
    if (last.centre !== String(x_c)) {
      // Without view_geometry another camera sees other colours, and the same motion.
      if (model.header.effects.includes("view_geometry")) last.t = null;
      const gaussians = p4dgs.spatialPrediction(model, x_c);
      seen.set(model, Object.assign(last, { centre: String(x_c), gaussians }));
    }
    const { gaussians } = last;
    const { x, s, r } = gaussians;
    if (!canonical && last.t !== t) Object.assign(last, { t, moved: deform(model, gaussians, t) });
    const moved = canonical ? { x_t: x, s_t: s, r_t: r } : last.moved;
    return { gaussians, moved, splats: p4dgs.splatting(gaussians, moved, camera) };
  }

  /** What the two paths need beside the splats. */
  function settings({ header }, camera, background = header.background) {
    const occlusion = header.effects.includes("occlusion");
    return { background, size: camera.size, occlusion, alpha_max: ALPHA_MAX, least: LEAST };
  }

  // --- on the processor -------------------------------------------------------------------------
  /** The picture as bytes for a canvas, [height, width, 4]. */
  function onProcessor(splats, scene) {
    const { image } = p4dgs.compositing(splats, scene);
    const pixels = new Uint8ClampedArray((image.length / 3) * 4); // rounds, and clips to 0 ... 255
    for (let i = 0, o = 0; i < image.length; i += 3, o += 4) {
      pixels[o] = 255 * image[i];
      pixels[o + 1] = 255 * image[i + 1];
      pixels[o + 2] = 255 * image[i + 2];
      pixels[o + 3] = 255;
    }
    return pixels;
  }

  // --- by WebGL2 --------------------------------------------------------------------------------
  const VERTEX = `#version 300 es
    uniform vec2 size;             // of the picture, in pixels
    in vec2 corner;                // of the quad, 0 or 1
    in vec4 box;                   // left, top, right and bottom of the ellipse
    in vec3 conic, color, place;   // place: the centre's two coordinates, and alpha
    flat out vec3 Conic, Color, Place;
    void main() {
      vec2 at = mix(box.xy, box.zw, corner) / size * 2.0 - 1.0;
      gl_Position = vec4(at.x, -at.y, 0.0, 1.0);
      Conic = conic; Color = color; Place = place;
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    uniform vec2 size;
    uniform float least, alpha_max;
    flat in vec3 Conic, Color, Place;
    out vec4 result;
    void main() {
      // A pixel's centre is a whole number, and the first row is the upper one.
      vec2 e = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) - 0.5 - Place.xy;
      float E = 0.5 * (Conic.x * e.x * e.x + Conic.z * e.y * e.y) + Conic.y * e.x * e.y;
      float o = min(alpha_max, Place.z * exp(-max(E, 0.0)));
      if (abs(o) < least) discard;
      result = vec4(o * Color, o);
    }`;
  const INPUTS = { box: 4, conic: 3, color: 3, place: 3 };
  const FLOATS = 13;

  class WebGL {
    /** Throws an Error where the browser has no WebGL2. */
    constructor(canvas) {
      const options = { alpha: false, antialias: false, preserveDrawingBuffer: true };
      const gl = canvas.getContext("webgl2", options);
      if (!gl) throw new Error("no WebGL");
      const program = gl.createProgram();
      for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
        const shader = gl.createShader(type);
        gl.shaderSource(shader, source);
        gl.compileShader(shader);
        gl.attachShader(program, shader);
      }
      gl.linkProgram(program);
      if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error("no WebGL");
      gl.useProgram(program);
      Object.assign(this, { canvas, gl, program, buffer: gl.createBuffer(), deep: null });
      const corners = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, corners);
      gl.bufferData(gl.ARRAY_BUFFER, Float32Array.of(0, 0, 1, 0, 0, 1, 1, 1), gl.STATIC_DRAW);
      this.input("corner", 2, 8, 0, 0);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
      let first = 0;
      for (const [name, width] of Object.entries(INPUTS)) {
        this.input(name, width, 4 * FLOATS, 4 * first, 1);
        first += width;
      }
      this.hasFloats = gl.getExtension("EXT_color_buffer_float") !== null;
      gl.enable(gl.BLEND);
    }

    /** One input of the vertex shader; every `divisor` instances it takes its next row. */
    input(name, width, stride, offset, divisor) {
      const { gl, program } = this;
      const place = gl.getAttribLocation(program, name);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, width, gl.FLOAT, false, stride, offset);
      gl.vertexAttribDivisor(place, divisor);
    }

    /** Draws into 16-bit floats where there are any: 8 bits would lose the faint Gaussians. */
    resize(width, height) {
      const { gl, canvas } = this;
      if (canvas.width === width && canvas.height === height && (this.deep || !this.hasFloats)) {
        return;
      }
      [canvas.width, canvas.height] = [width, height];
      if (!this.hasFloats) return;
      if (this.deep) gl.deleteFramebuffer(this.deep);
      if (this.texture) gl.deleteTexture(this.texture);
      this.texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
      this.deep = gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.deep);
      const at = gl.COLOR_ATTACHMENT0;
      gl.framebufferTexture2D(gl.FRAMEBUFFER, at, gl.TEXTURE_2D, this.texture, 0);
    }

    draw(splats, scene) {
      const { gl, program } = this;
      const { background, occlusion, least, alpha_max, size } = scene;
      const [width, height] = size;
      this.resize(width, height);
      const { rows, count } = quads(splats, scene);
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.deep);
      gl.viewport(0, 0, width, height);
      gl.clearColor(...background, 1);
      gl.clear(gl.COLOR_BUFFER_BIT);
      gl.blendFunc(gl.ONE, occlusion ? gl.ONE_MINUS_SRC_ALPHA : gl.ONE);
      gl.uniform2f(gl.getUniformLocation(program, "size"), width, height);
      gl.uniform1f(gl.getUniformLocation(program, "least"), least);
      gl.uniform1f(gl.getUniformLocation(program, "alpha_max"), alpha_max);
      gl.bufferData(gl.ARRAY_BUFFER, rows, gl.DYNAMIC_DRAW);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
      if (!this.deep) return;
      gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.deep);
      gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
      const all = [0, 0, width, height];
      gl.blitFramebuffer(...all, ...all, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    }
  }

  /** A row of FLOATS for each Gaussian that can be seen, the farthest first, and their count. */
  function quads(splats, { size, least }) {
    const { mean2d, cov2d, conic, alpha, color } = splats;
    const order = p4dgs.frontToBack(splats).reverse();
    const rows = new Float32Array(FLOATS * order.length);
    let count = 0;
    for (const n of order) {
      const [u, v] = [mean2d[2 * n], mean2d[2 * n + 1]];
      const reach = 2 * Math.log(Math.abs(alpha[n]) / least);
      const [wide, tall] = [cov2d[3 * n], cov2d[3 * n + 2]].map((c) => Math.sqrt(reach * c));
      const box = [Math.max(u - wide, -0.5), Math.max(v - tall, -0.5)];
      box.push(Math.min(u + wide, size[0] - 0.5), Math.min(v + tall, size[1] - 0.5));
      if (!(reach > 0 && box[0] < box[2] && box[1] < box[3])) continue;
      const at = FLOATS * count++;
      for (let i = 0; i < 4; i++) rows[at + i] = box[i] + 0.5; // a pixel ends half a unit further
      for (let i = 0; i < 3; i++) {
        rows[at + 4 + i] = conic[3 * n + i];
        rows[at + 7 + i] = color[3 * n + i];
      }
      rows.set([u, v, alpha[n]], at + 10);
    }
    return { rows: rows.subarray(0, FLOATS * count), count };
  }

  // --- colours ----------------------------------------------------------------------------------
  // From dark blue to yellow: lightness rises all the way, so it is read without colour vision.
  const VIRIDIS = [
    [68, 1, 84], [71, 44, 122], [59, 81, 139],
    [44, 113, 142], [33, 144, 141], [39, 173, 129],
    [92, 200, 99], [170, 220, 50], [253, 231, 37],
  ];

  /** The colour at 0 ... 1 of viridis, three numbers from 0 to 1. */
  function viridis(share) {
    const at = Math.min(Math.max(share, 0), 1) * (VIRIDIS.length - 1);
    const i = Math.min(Math.floor(at), VIRIDIS.length - 2);
    return VIRIDIS[i].map((v, c) => (v + (VIRIDIS[i + 1][c] - v) * (at - i)) / 255);
  }

  /** A colour as text for a canvas or a style. */
  const rgb = (color) => `rgb(${Array.from(color, (v) => Math.round(255 * v)).join(" ")})`;
  const css = (share) => rgb(viridis(share));

  Object.assign(exported, { tooLarge, see, deform, settings, onProcessor, WebGL, viridis, css });
  Object.assign(exported, { products, rgb });
})(typeof module === "object" ? module.exports : (globalThis.draw = {}));
