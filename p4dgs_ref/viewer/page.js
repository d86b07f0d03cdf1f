// The page: its state, its controls, and when it draws.
//
// Every control changes `state` and asks for a picture; `paint` draws what the state says, once a
// frame of the screen. A file that cannot be shown leaves the state as it was.
"use strict";

(function (exported) {
  const { p4dgs, draw, requantise, layers, explain } = globalThis;
  const $ = (id) => document.getElementById(id);
  const { element } = explain;

  const FIELD = (41 * Math.PI) / 180; // the angle of view
  const PERIOD = 4000; // milliseconds in which time runs from 0 to 1
  const COMPARED = 128; // pixels along a side of the pictures whose PSNR is told
  const MOST_BYTES = 2 ** 29;

  const LAYERS = {
    anchors: ["Anchors", "Squares at x_a; a larger, lighter square costs more bits."],
    ellipses: ["Children's ellipses", "Every Gaussian at one standard deviation."],
    motion: ["Canonical against deformed", "From a ring at x to a dot at x_t, Eqs. (5) and (6)."],
    paths: ["Paths over time", "From time 0 (thin, dark) to 1 (thick, light, with a dot)."],
    hidden: ["Children below τ_α", "Crosses on those that this camera does not see, Eq. (3)."],
    grid: ["Hash grid", "Nodes of a level, Eq. (9), and the cell of the chosen anchor."],
  };

  const PARTS = {
    container: "Magic, version, lengths of the sections, checksum.",
    header: "The design: widths, effects, levels, background.",
    positions: "The box of the scene, and a lattice point for each anchor.",
    features: "f_a: what the networks read of each anchor.",
    scales: "s_a: how large the children of an anchor may be.",
    offset_scales: "l_a: how far from the anchor they stand.",
    offsets: "O_a: where each child stands.",
    masks: "One flag for each child: is it drawn?",
    hash_grid: "Signs at the nodes of the grid, from which the context is read.",
    deformation_mlp: "ψ_d: how every Gaussian moves, Eq. (5).",
    anchor_mlps: "ψ_α, ψ_c, ψ_r, ψ_s: opacity, colour, rotation, scale; Eqs. (3) and (4).",
    context_mlps: "ψ_p, ψ_q: means, deviations and steps, Eqs. (8) and (12).",
  };

  const state = {
    name: "",
    data: null, // the file's bytes
    sections: {},
    model: null, // as it is in the file
    changed: null, // requantised: {model, bytes}, or null
    bits: null,
    azimuth: 0,
    elevation: 0,
    distance: 1,
    playing: false,
    phase: 0, // of time to and fro: 0 ... 2
    shown: new Set(),
    selected: null,
    canvas: false,
    unchanged: false,
  };

  // --- camera -----------------------------------------------------------------------------------
  const middle = ({ lo, hi }) => lo.map((v, i) => (v + hi[i]) / 2);

  /** How far away the camera stands at first, so that the box fills the picture. */
  const homeDistance = ({ lo, hi }) =>
    1.36 * Math.hypot(...hi.map((v, i) => v - lo[i])) || 1;

  function goHome() {
    const distance = homeDistance(state.model);
    Object.assign(state, { azimuth: 40, elevation: 30, distance });
  }

  /** The camera that looks at the middle of the box; angles in degrees. */
  function cameraOf({ model, azimuth, elevation, distance }, pixels) {
    const [a, e] = [azimuth, elevation].map((angle) => (angle * Math.PI) / 180);
    const [sin_a, cos_a, sin_e, cos_e] = [Math.sin(a), Math.cos(a), Math.sin(e), Math.cos(e)];
    const W = [-sin_a, cos_a, 0, sin_e * cos_a, sin_e * sin_a, -cos_e];
    W.push(-cos_e * cos_a, -cos_e * sin_a, -sin_e);
    const [x, y, z] = middle(model);
    const T = [0, 1, 2].map((i) => -(W[3 * i] * x + W[3 * i + 1] * y + W[3 * i + 2] * z));
    T[2] += distance;
    const focal = pixels / 2 / Math.tan(FIELD / 2);
    const center = (pixels - 1) / 2;
    const size = [pixels, pixels];
    return { W, T, focal: [focal, focal], center: [center, center], size };
  }

  let lastCamera = null;

  /** The same object as long as nothing moves: what depends on the camera alone is then kept. */
  function camera() {
    const made = cameraOf(state, Number($("size").value));
    if (JSON.stringify(made) !== JSON.stringify(lastCamera)) lastCamera = made;
    return lastCamera;
  }

  const time = () => Number($("time").value);

  function turn(azimuth, elevation) {
    state.azimuth = (state.azimuth + azimuth) % 360;
    state.elevation = Math.min(Math.max(state.elevation + elevation, -89), 89);
    ask();
  }

  function zoom(factor) {
    const home = homeDistance(state.model);
    state.distance = Math.min(Math.max(state.distance * factor, home / 10), home * 10);
    ask();
  }

  // --- drawing ----------------------------------------------------------------------------------
  let glass = null; // WebGL2, or null
  let asked = false;

  /** Asks for a new picture with the next frame of the screen. */
  function ask() {
    if (asked) return;
    asked = true;
    requestAnimationFrame((now) => {
      asked = false;
      paint(now);
    });
  }

  function openGlass() {
    try {
      glass = new draw.WebGL($("glass"));
      $("glass").addEventListener("webglcontextlost", () => {
        glass = null;
        ask();
      });
    } catch {
      glass = null;
    }
  }

  /** The model that is shown: the file's, or the requantised one. */
  const current = () => (state.changed && !state.unchanged ? state.changed.model : state.model);

  let before = null;

  /** Moves time on while it plays. */
  function advance(now) {
    if (state.playing && before !== null) {
      state.phase = (state.phase + Math.min(now - before, 200) / PERIOD) % 2;
      $("time").value = String(state.phase < 1 ? state.phase : 2 - state.phase);
    }
    before = state.playing ? now : null;
    $("time-now").value = time().toFixed(2);
  }

  /** Writes a text where it is another one, so that it is not read aloud with every picture. */
  function tell(id, text) {
    if ($(id).textContent !== text) $(id).textContent = text;
  }

  /** Draws splats by WebGL2 or on the canvas; returns what the corner says. */
  function show(splats, scene) {
    const flat = state.canvas || !glass;
    $("picture").hidden = !flat;
    $("glass").hidden = flat;
    if (!flat) {
      glass.draw(splats, scene);
      return "WebGL2";
    }
    const canvas = $("picture");
    const [width, height] = scene.size;
    if (canvas.width !== width || canvas.height !== height) {
      [canvas.width, canvas.height] = [width, height];
    }
    const pixels = draw.onProcessor(splats, scene);
    canvas.getContext("2d").putImageData(new ImageData(pixels, width, height), 0, 0);
    return glass ? "canvas path" : "no WebGL: canvas path";
  }

  /** Colours of the anchors' bits in the place of those of the scene. */
  function bitColors({ gaussians, splats }) {
    const { k } = state.model.header;
    const color = new Float64Array(3 * splats.alpha.length);
    const { share } = bits();
    gaussians.index.forEach((child, n) => {
      color.set(draw.viridis(share(Math.floor(child / k))), 3 * n);
    });
    return { ...splats, color };
  }

  function paint(now) {
    const { model } = state;
    if (!model) return;
    advance(now);
    const start = performance.now();
    const [drawn, seen, t, what] = [current(), camera(), time(), $("shown").value];
    const found = draw.see(drawn, seen, t, { canonical: what === "canonical" });
    const isBits = what === "bits";
    const scene = draw.settings(drawn, seen, isBits ? [1, 1, 1] : undefined);
    const path = show(isBits ? bitColors(found) : found.splats, scene);
    const frame = { ...found, model: drawn, camera: seen, t, selected: state.selected };
    drawAbove(frame);
    const spent = performance.now() - start;
    const count = found.gaussians.index.length.toLocaleString("en");
    $("corner").textContent = `${path} · ${count} Gaussians · ${spent.toFixed(0)} ms`;
    state.frame = frame;
    if (state.changed) compareSoon();
    if (state.playing) ask();
    else explainSoon();
  }

  /** The layers, at the resolution of the screen. */
  function drawAbove(frame) {
    const canvas = $("above");
    const side = $("stage").clientWidth;
    const fine = window.devicePixelRatio || 1;
    const pixels = Math.round(side * fine);
    if (canvas.width !== pixels) canvas.width = canvas.height = pixels;
    const context = canvas.getContext("2d");
    context.setTransform(fine, 0, 0, fine, 0, 0);
    context.clearRect(0, 0, side, side);
    frame.scale = side / frame.camera.size[0];
    frame.level = Number($("level").value);
    frame.bits = state.shown.has("anchors") ? bits() : null;
    const notes = Object.entries(layers.LAYERS)
      .filter(([name]) => state.shown.has(name))
      .map(([, layer]) => layer(context, frame));
    tell("layers-say", notes.filter(Boolean).join(" "));
    layers.selection(context, frame);
  }

  // --- bits -------------------------------------------------------------------------------------
  /** The bits of the file's anchors, and each anchor's share between the least and the most. */
  function bits() {
    if (state.bits) return state.bits;
    const each = requantise.anchorBits(state.model);
    const [least, most] = [each.reduce(lesser), each.reduce(greater)];
    const share = (a) => (most > least ? (each[a] - least) / (most - least) : 0.5);
    return (state.bits = { each, least, most, share });
  }

  const lesser = (a, b) => Math.min(a, b);
  const greater = (a, b) => Math.max(a, b);

  function drawLegend() {
    const isShown = $("shown").value === "bits" || state.shown.has("anchors");
    $("legend").hidden = !isShown;
    if (!isShown) return;
    const stops = [0, 0.25, 0.5, 0.75, 1].map(draw.css);
    $("legend-colors").style.background = `linear-gradient(to right, ${stops.join(", ")})`;
    $("legend-low").textContent = `${bits().least.toFixed(0)} bits an anchor`;
    $("legend-high").textContent = `${bits().most.toFixed(0)} bits`;
  }

  // --- the file as a strip ----------------------------------------------------------------------
  /** Bytes of the frame of the file and of each section, from those of the sections. */
  function withContainer(sections) {
    const inFile = Object.values(state.model.bytes).reduce((sum, size) => sum + size, 0);
    return { container: state.data.length - inFile, ...sections };
  }

  const percent = (part, all) => `${((100 * part) / all).toFixed(1)} %`;
  const whole = (count) => count.toLocaleString("en");
  const total = (sizes) => Object.values(sizes).reduce((sum, size) => sum + size, 0);

  function drawStrip() {
    $("section-says").textContent = ""; // its bytes may be others now
    const own = withContainer(state.model.bytes);
    const now = withContainer(state.changed ? state.changed.bytes : state.model.bytes);
    const names = Object.keys(own);
    $("file-says").textContent =
      `${state.name}: ${whole(state.data.length)} bytes, version ${state.model.version} of the ` +
      `format, ${whole(state.model.header.anchors)} anchors of ${state.model.header.k} children.`;
    $("strip").replaceChildren(...names.map((name, i) => partOf(name, i, names.length, now)));
    const estimate = (size) => (state.changed ? [whole(size)] : []);
    const row = (name, size, changed, says) => {
      const share = percent(size, state.data.length);
      return [name, whole(size), share, ...estimate(changed), says];
    };
    const rows = names.map((name, i) => row(`${i + 1} ${name}`, own[name], now[name], PARTS[name]));
    rows.push(row("all", state.data.length, total(now), ""));
    const estimated = state.changed ? ["estimate"] : [];
    const head = ["section", "bytes", "share", ...estimated, "what it holds"];
    $("sections").replaceChildren(explain.table("Sections of the file", head, rows));
  }

  /** One section of the strip: as wide as its bytes, with the number of its row in the table. */
  function partOf(name, i, count, sizes) {
    const said = `${i + 1} ${name}: ${whole(sizes[name])} bytes. ${PARTS[name]}`;
    const label = element("span", {}, String(i + 1));
    const button = element("button", { title: said, "aria-label": said }, label);
    button.setAttribute("aria-pressed", "false");
    button.style.flex = `${sizes[name]} 1 0.8rem`;
    button.style.setProperty("--part", draw.css((i / count) * 0.85));
    button.addEventListener("click", () => {
      for (const other of $("strip").children) other.setAttribute("aria-pressed", "false");
      button.setAttribute("aria-pressed", "true");
      $("section-says").textContent = said;
    });
    return button;
  }

  // --- requantising -----------------------------------------------------------------------------
  const changes = () => ({
    coarser: 2 ** Number($("coarser").value),
    dropped: Number($("dropped").value),
    masks: $("masks").checked,
    context: $("context").checked,
  });

  function change() {
    const how = changes();
    const isSame = Object.entries(requantise.UNCHANGED).every(([key, v]) => how[key] === v);
    state.changed = isSame ? null : requantise.requantise(state.model, state.sections, how);
    $("coarser-now").value = String(Number(how.coarser.toPrecision(2)));
    $("dropped-now").value = String(how.dropped);
    showUnchanged(false);
    drawStrip();
    compare();
    ask();
  }

  function undo() {
    for (const id of ["coarser", "dropped"]) $(id).value = "0";
    for (const id of ["masks", "context"]) $(id).checked = true;
    change();
  }

  function showUnchanged(isShown) {
    state.unchanged = isShown;
    $("unchanged").setAttribute("aria-pressed", String(isShown));
    ask();
  }

  /** A picture of a model for the comparison, on the processor. */
  function small(model) {
    const seen = cameraOf(state, COMPARED);
    return draw.onProcessor(draw.see(model, seen, time()).splats, draw.settings(model, seen));
  }

  /** Tells bytes and PSNR of the changed file. */
  function compare() {
    $("unchanged").disabled = $("reset").disabled = !state.changed;
    $("trio").hidden = !state.changed;
    if (!state.changed) {
      $("result").textContent = "Nothing is changed.";
      return;
    }
    const estimate = total(withContainer(state.changed.bytes));
    const [own, now] = [small(state.model), small(state.changed.model)];
    const gap = own.map((v, i) => (i % 4 === 3 ? 255 : 4 * Math.abs(v - now[i])));
    for (const [name, pixels] of Object.entries({ own, now, gap })) {
      const canvas = $(`trio-${name}`);
      canvas.width = canvas.height = COMPARED; // which also clears it
      canvas.getContext("2d").putImageData(new ImageData(pixels, COMPARED, COMPARED), 0, 0);
    }
    const found = requantise.psnr(own, now);
    const quality = Number.isFinite(found) ? `${found.toFixed(1)} dB` : "no difference";
    $("result").textContent =
      `About ${whole(estimate)} bytes, ${percent(estimate, state.data.length)} of the file. ` +
      `PSNR of this view against the unchanged file: ${quality}.`;
  }

  /** Calls a function at most once within some milliseconds, at their end. */
  function later(call, milliseconds) {
    let waiting = null;
    return () => {
      waiting ??= setTimeout(() => {
        waiting = null;
        if (state.model) call();
      }, milliseconds);
    };
  }

  const compareSoon = later(compare, 400);

  // --- one anchor -------------------------------------------------------------------------------
  function select(anchor) {
    state.selected = anchor;
    $("anchor").value = anchor === null ? "" : String(anchor);
    state.explained = null;
    ask();
    if (anchor === null) $("anchor-tables").replaceChildren();
    else explainSoon(); // also while time runs
  }

  /** The tables of the selected anchor, where the camera or the time are others than before. */
  function explainAnchor() {
    const { frame, selected } = state;
    if (selected === null || !frame || state.explained === frame) return;
    state.explained = frame;
    const scrolled = [...$("anchor-tables").children].map(({ scrollTop }) => scrollTop);
    const [model, seen, t] = [state.model, frame.camera, frame.t];
    const own = { model, camera: seen, t, ...draw.see(model, seen, t) }; // not the requantised one
    const tables = explain.anchor(own, selected, 8 * state.data.length);
    $("anchor-tables").replaceChildren(...tables);
    tables.forEach((table, i) => (table.scrollTop = scrolled[i] ?? 0));
  }

  const explainSoon = later(explainAnchor, 120);

  function step(by) {
    const { anchors } = state.model.header;
    const from = state.selected ?? (by > 0 ? -1 : 0);
    select((from + by + anchors) % anchors);
  }

  // --- files ------------------------------------------------------------------------------------
  const PATIENCE = 60; // seconds in which a file must be decoded
  const DECODE = `onmessage = ({ data }) => {
    try {
      postMessage({ model: p4dgs.decode(data) });
    } catch (error) {
      postMessage({ said: error.message });
    }
  };`;

  let end = () => {}; // of the decoding that is under way

  /** The model in a file. It is decoded beside the page, which goes on meanwhile, until it takes
   *  too long or another file is opened; then the promise is never kept. */
  function decoded(data) {
    end();
    const port = $("files").nextElementSibling.text; // p4dgs.js, where it is inside of the page
    const url = URL.createObjectURL(new Blob([port, DECODE], { type: "text/javascript" }));
    const worker = port && workerOf(url);
    if (!worker) return Promise.resolve(p4dgs.decode(data));
    return new Promise((resolve, reject) => {
      const late = `decoding takes more than ${PATIENCE} seconds`;
      const timer = setTimeout(() => settle(reject, new Error(late)), 1000 * PATIENCE);
      end = () => {
        clearTimeout(timer);
        worker.terminate();
        URL.revokeObjectURL(url);
      };
      const settle = (call, value) => {
        end();
        call(value);
      };
      worker.onmessage = ({ data: { model, said } }) =>
        model ? settle(resolve, model) : settle(reject, new Error(said));
      worker.onerror = () => settle(reject, new Error("the browser cannot decode it"));
      worker.postMessage(data);
    });
  }

  /** A worker, or null where the browser allows none to a page from disk. */
  function workerOf(url) {
    try {
      return new Worker(url);
    } catch {
      return null;
    }
  }

  /** Says in one line why a file is not shown. The scene before it stays. */
  function refuse(name, said) {
    const stays = state.model ? ` The previous scene, ${state.name}, stays.` : "";
    $("message").textContent = `${name}: ${said}.${stays}`;
  }

  /** Shows a model and the bytes that it comes from, if it is small enough for this page. */
  function load(name, data, model) {
    const large = draw.tooLarge(model);
    if (large) {
      refuse(name, large);
      return;
    }
    const { sections } = p4dgs.openContainer(data);
    const size = state.model ? homeDistance(state.model) : Infinity;
    Object.assign(state, { name, data, model, sections, bits: null, changed: null });
    $("message").textContent = "";
    $("all").hidden = false; // the controls need a scene
    if (Math.abs(homeDistance(model) - size) > 0.2 * size || size === Infinity) goHome();
    opened(); // from where the camera stands, if the scenes are as large as each other
  }

  /** After a file was opened: everything that belongs to it. */
  function opened() {
    const { grid } = state.model.header;
    const options = grid.map(([axes, R], i) =>
      element("option", { value: String(i) }, `${axes}, ${R} nodes along an axis`),
    );
    $("level").replaceChildren(...options);
    $("anchor").max = String(state.model.header.anchors - 1);
    select(null);
    undo();
    drawLegend();
  }

  let request = 0; // files so far; the last one that is asked for is shown, whichever ends last

  async function open(file) {
    if (!file) return;
    const own = ++request;
    $("message").textContent = "";
    try {
      const isLarge = file.size > MOST_BYTES;
      if (isLarge) throw new Error("container, byte 10: expected at most 2^29 bytes");
      const data = new Uint8Array(await file.arrayBuffer());
      const model = own === request && (await decoded(data));
      if (own !== request) return;
      load(file.name, data, model);
      $("embedded").hidden = $("scene").options.length === 0;
      if (state.data === data) $("scene").selectedIndex = -1; // each embedded file can be chosen
    } catch (error) {
      if (own === request) refuse(file.name, error.message);
    }
  }

  const decodeBase64 = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

  function embedded() {
    const files = JSON.parse($("files").textContent);
    const options = files.map(({ name, base64 }, i) => {
      const size = whole(decodeBase64(base64).length);
      return element("option", { value: String(i) }, `${name}, ${size} bytes`);
    });
    $("scene").replaceChildren(...options);
    $("embedded").hidden = files.length < 2;
    const choose = (i) => {
      end();
      request += 1;
      const data = decodeBase64(files[i].base64);
      try {
        load(files[i].name, data, p4dgs.decode(data));
      } catch (error) {
        refuse(files[i].name, error.message);
      }
    };
    $("scene").addEventListener("change", () => choose(Number($("scene").value)));
    if (files.length) choose(0);
    else $("message").textContent = "Open a .p4dgs file, or drop one on this page.";
  }

  // --- controls ---------------------------------------------------------------------------------
  function play(isPlaying) {
    state.playing = isPlaying;
    state.phase = time();
    $("play").setAttribute("aria-pressed", String(isPlaying));
    $("play").textContent = isPlaying ? "❚❚ Pause" : "▶ Play";
    ask();
  }

  function layerControls() {
    const controls = Object.entries(LAYERS).map(([name, [label, says]]) => {
      const [id, described] = [`layer-${name}`, `layer-${name}-says`];
      const box = element("input", { type: "checkbox", id, "aria-describedby": described });
      box.addEventListener("change", () => {
        state.shown[box.checked ? "add" : "delete"](name);
        drawLegend();
        ask();
      });
      const text = element("label", { for: id }, label);
      const said = element("small", { id: described }, says);
      return element("div", { class: "check" }, box, text, said);
    });
    $("layers").replaceChildren(...controls);
  }

  /** What a key does while the picture has the focus. */
  function keys() {
    const layer = (i) => () => $(`layer-${Object.keys(LAYERS)[i]}`).click();
    const later = (by) => () => {
      $("time").value = String(time() + by);
      state.phase = time();
      ask();
    };
    return {
      ArrowLeft: () => turn(-5, 0),
      ArrowRight: () => turn(5, 0),
      ArrowUp: () => turn(0, 5),
      ArrowDown: () => turn(0, -5),
      "+": () => zoom(0.9),
      "=": () => zoom(0.9),
      "-": () => zoom(1 / 0.9),
      " ": () => play(!state.playing),
      ",": later(-0.02),
      ".": later(0.02),
      "[": () => step(-1),
      "]": () => step(1),
      Home: home,
      Escape: () => select(null),
      ...Object.fromEntries(Object.keys(LAYERS).map((_, i) => [String(i + 1), layer(i)])),
    };
  }

  function home() {
    goHome();
    ask();
  }

  /** Mouse and touch: one pointer turns, two zoom, a short one selects. */
  function pointers(stage) {
    const down = new Map(); // the pointers that touch the stage, and where they are
    let moved = 0;
    const apart = () => {
      const [a, b] = [...down.values()];
      return Math.hypot(a.x - b.x, a.y - b.y);
    };
    stage.addEventListener("pointerdown", (event) => {
      stage.setPointerCapture(event.pointerId);
      down.set(event.pointerId, { x: event.clientX, y: event.clientY });
      moved = down.size > 1 ? Infinity : 0;
    });
    stage.addEventListener("pointermove", (event) => {
      const from = down.get(event.pointerId);
      if (!from || !state.model) return;
      const was = down.size === 2 ? apart() : 0;
      const [x, y] = [event.clientX, event.clientY];
      down.set(event.pointerId, { x, y });
      moved += Math.hypot(x - from.x, y - from.y);
      if (down.size === 2) zoom(was / Math.max(apart(), 1));
      else turn(-0.5 * (x - from.x), 0.5 * (y - from.y));
    });
    const up = (event) => {
      const isClick = event.type === "pointerup" && moved < 5 && down.has(event.pointerId);
      down.delete(event.pointerId);
      if (!isClick || !state.frame) return;
      const box = stage.getBoundingClientRect();
      select(layers.nearest(state.frame, event.clientX - box.left, event.clientY - box.top));
    };
    for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, up);
    const wheel = (event) => {
      event.preventDefault();
      if (state.model) zoom(Math.exp(Math.min(Math.max(event.deltaY, -200), 200) / 1000));
    };
    stage.addEventListener("wheel", wheel, { passive: false });
  }

  function controls() {
    const on = (id, event, call) => $(id).addEventListener(event, call);
    on("open", "change", () => {
      open($("open").files[0]);
      $("open").value = ""; // so that the same file can be opened again
    });
    on("play", "click", () => play(!state.playing));
    on("home", "click", home);
    on("time", "input", () => {
      state.phase = time();
      ask();
    });
    on("shown", "change", () => {
      drawLegend();
      ask();
    });
    for (const id of ["size", "level"]) on(id, "change", ask);
    on("canvas-path", "change", () => {
      state.canvas = $("canvas-path").checked;
      ask();
    });
    const changeSoon = later(change, 30);
    for (const id of ["coarser", "dropped", "masks", "context"]) on(id, "input", changeSoon);
    on("unchanged", "click", () => showUnchanged(!state.unchanged));
    on("reset", "click", undo);
    on("anchor", "change", () => {
      const asked = Number($("anchor").value);
      const isOne = $("anchor").value !== "" && Number.isInteger(asked);
      const { anchors } = state.model.header;
      select(isOne ? Math.min(Math.max(asked, 0), anchors - 1) : null);
    });
    const known = keys();
    on("stage", "keydown", (event) => {
      const call = !event.ctrlKey && !event.metaKey && !event.altKey && known[event.key];
      if (!call || !state.model) return;
      event.preventDefault();
      call();
    });
    pointers($("stage"));
    dropping();
    new ResizeObserver(ask).observe($("stage"));
  }

  /** A file may be dropped anywhere. */
  function dropping() {
    const on = (name, call) =>
      document.addEventListener(name, (event) => {
        event.preventDefault();
        document.body.classList.toggle("dropping", name === "dragover");
        call(event);
      });
    on("dragover", () => {});
    on("dragleave", () => {});
    on("drop", (event) => open(event.dataTransfer.files[0]));
  }

  openGlass();
  layerControls();
  controls();
  embedded();
  Object.assign(exported, { state, paint });
})((globalThis.page = {}));
