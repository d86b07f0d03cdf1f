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
  const COMPARED = 128; // pixels along a side of the pictures whose PSNR is measured
  const MOST_BYTES = 2 ** 29;
  const TURN = 16000; // milliseconds in which the camera goes around the scene by itself
  const SLOW = 50; // milliseconds; where frames take longer, a picture that moves has fewer pixels
  const MOST_FEWER = 4; // more would leave too little to see
  const WALK = 48; // places of a walk around the scene

  const state = {
    name: "",
    data: null, // the file's bytes
    model: null, // as it is in the file
    changed: null, // requantised: {model, bytes}, or null
    bits: null,
    azimuth: 0,
    elevation: 0,
    distance: 1,
    shift: [0, 0, 0], // from the middle of the box to where the camera looks
    isMoved: false, // the camera, by the visitor
    playing: false,
    turning: false, // the camera, by itself
    phase: 0, // of time, which runs forwards and backwards: 0 ... 2
    selected: null,
    painted: Infinity, // how many of the Gaussians, from front to back
    pixel: [0.5, 0.5], // whose Gaussians are listed; from 0 to 1 along the sides of the picture
    sign: null, // of the hash grid, which is flipped
    number: null, // of an anchor, whose bell is drawn
    fewer: 1, // pixels along a side are divided by it while the picture moves
  };

  // --- camera -----------------------------------------------------------------------------------
  const middle = ({ lo, hi }) => lo.map((v, i) => (v + hi[i]) / 2);

  /** How far away the camera stands at first, so that the box fills the picture. */
  const homeDistance = ({ lo, hi }) =>
    1.36 * Math.hypot(...hi.map((v, i) => v - lo[i])) || 1;

  function home() {
    Object.assign(state, { azimuth: 320, elevation: 30, distance: homeDistance(state.model) });
    Object.assign(state, { shift: [0, 0, 0], isMoved: false });
    ask();
  }

  /** The camera that looks at the middle of the box, or beside it; angles in degrees. */
  function cameraOf({ model, azimuth, elevation, distance, shift }, pixels) {
    const [a, e] = [azimuth, elevation].map((angle) => (angle * Math.PI) / 180);
    const [sin_a, cos_a, sin_e, cos_e] = [Math.sin(a), Math.cos(a), Math.sin(e), Math.cos(e)];
    const W = [-sin_a, cos_a, 0, sin_e * cos_a, sin_e * sin_a, -cos_e];
    W.push(-cos_e * cos_a, -cos_e * sin_a, -sin_e);
    const [x, y, z] = middle(model).map((v, i) => v + shift[i]);
    const T = [0, 1, 2].map((i) => -(W[3 * i] * x + W[3 * i + 1] * y + W[3 * i + 2] * z));
    T[2] += distance;
    const focal = pixels / 2 / Math.tan(FIELD / 2);
    const center = (pixels - 1) / 2;
    return { W, T, focal: [focal, focal], center: [center, center], size: [pixels, pixels] };
  }

  const time = () => Number($("time").value);
  const isShown = (id) => $(id).offsetParent !== null;
  const clip = (v, low, high) => Math.min(Math.max(v, low), high);

  /** Sets those of azimuth, elevation, distance and shift that are given, within their ranges. */
  function aim(changes) {
    const to = { ...state, ...changes };
    const home = homeDistance(state.model);
    const shift = to.shift.map((v) => clip(v, -2 * home, 2 * home));
    const elevation = clip(to.elevation, -89, 89);
    const distance = clip(to.distance, home / 10, home * 10);
    const azimuth = ((to.azimuth % 360) + 360) % 360;
    Object.assign(state, { azimuth, elevation, distance, shift, isMoved: true, turning: false });
    moving();
  }

  function turn(azimuth, elevation) {
    aim({ azimuth: state.azimuth + azimuth, elevation: state.elevation + elevation });
  }

  const zoom = (factor) => aim({ distance: state.distance * factor });

  /** Moves the scene by some pixels of the stage. */
  function pan(right, down) {
    const { W } = cameraOf(state, 1);
    const unit = (2 * state.distance * Math.tan(FIELD / 2)) / $("stage").clientWidth;
    aim({ shift: state.shift.map((v, i) => v - unit * (right * W[i] + down * W[3 + i])) });
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
  const current = () => state.changed?.model ?? state.model;

  let [before, slowFrames, atRest] = [null, 0, 0];
  const goesOn = () => state.playing || state.turning;
  /** Moves time or the camera on. */
  function advance(now) {
    const spent = before === null ? 0 : Math.min(now - before, 200);
    if (state.playing) {
      state.phase = (state.phase + spent / PERIOD) % 2;
      $("time").value = String(state.phase < 1 ? state.phase : 2 - state.phase);
    }
    if (state.turning) state.azimuth = (state.azimuth + (360 * spent) / TURN) % 360;
    before = goesOn() ? now : null;
    $("time-now").value = time().toFixed(2);
  }

  /** Asks for a picture while the visitor moves it; another one follows when it is at rest. */
  function moving() {
    clearTimeout(atRest);
    atRest = setTimeout(() => {
      atRest = 0;
      state.fewer = Math.max(state.fewer / 2, 1); // the next time, more pixels are tried
      ask();
    }, 250);
    ask();
  }

  /** Pixels along a side: fewer while the picture moves and three in a row were slow. If this
   *  script was quick and they were very slow, WebGL has no graphics card, and the canvas path is
   *  faster. `interval` is the time since the last frame, or 0. */
  function pixels(interval) {
    const all = Number($("size").value);
    if (!goesOn() && !atRest) return all;
    slowFrames = Math.max(state.spent, interval) > SLOW ? (slowFrames % 3) + 1 : 0;
    if (slowFrames === 3) state.fewer = Math.min(2 * state.fewer, MOST_FEWER);
    const isIdle = interval > 4 * Math.max(state.spent, SLOW);
    if (slowFrames === 3 && isIdle) $("canvas-path").checked = true;
    return Math.max(Math.round(all / state.fewer), Math.min(all, 64));
  }

  /** Writes a text only if it has changed, so that it is not read aloud with every picture. */
  function tell(id, text) {
    if ($(id).textContent !== text) $(id).textContent = text;
  }

  /** Draws splats by WebGL2 or on the canvas; returns what the corner says. */
  function show(splats, scene) {
    const flat = $("canvas-path").checked || !glass;
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

  /** Colours of the anchors' bits in place of those of the scene. */
  function bitColors({ gaussians, splats }) {
    const { k } = state.model.header;
    const color = new Float64Array(3 * splats.alpha.length);
    const { share } = bits();
    const put = (child, n) => color.set(draw.viridis(share(Math.floor(child / k))), 3 * n);
    gaussians.index.forEach(put);
    return { ...splats, color };
  }

  function paint(now) {
    const { model } = state;
    if (!model) return;
    const interval = before === null ? 0 : now - before;
    advance(now);
    const start = performance.now();
    const seen = cameraOf(state, pixels(interval));
    const [drawn, t, what] = [current(), time(), $("shown").value];
    const found = draw.see(drawn, seen, t, { canonical: what === "canonical" });
    const order = p4dgs.frontToBack(found.splats);
    const count = Math.min(state.painted, order.length);
    for (const n of order.slice(count)) found.splats.visible[n] = 0;
    const isBits = what === "bits";
    const scene = draw.settings(drawn, seen, isBits ? [1, 1, 1] : undefined);
    const path = show(isBits ? bitColors(found) : found.splats, scene);
    const frame = { ...found, model: drawn, camera: seen, t, selected: state.selected };
    drawAbove(frame, isBits);
    if (isShown("pixel")) showPixel(frame, order, count);
    Object.assign(state, { frame, spent: performance.now() - start });
    const said = `${whole(found.gaussians.index.length)} Gaussians · ${seen.size[0]} px`;
    $("corner").textContent = `${path} · ${said} · ${state.spent.toFixed(0)} ms`;
    if ($("walker")) $("walker").style.left = `${state.azimuth / 3.6}%`;
    if (state.changed) compareSoon();
    if (goesOn()) ask();
    else explainSoon();
    document.dispatchEvent(new Event("painted"));
  }

  /** How many Gaussians are painted, and those of the chosen pixel. */
  function showPixel(frame, order, count) {
    $("splats").max = String(order.length);
    $("splats").value = String(count);
    $("splats-now").value = `${whole(count)} of ${whole(order.length)}`;
    const at = state.pixel.map((share) => Math.round(share * frame.camera.size[0] - 0.5));
    $("pixel").replaceChildren(...explain.pixel(frame, order, count, at));
  }

  /** The layers, at the resolution of the screen, and the legend of bits where they are shown. */
  function drawAbove(frame, isBits) {
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
    $("legend").hidden = !isBits;
    if (isBits) tell("legend-low", `${bits().least.toFixed(0)} bits per anchor`);
    if (isBits) tell("legend-high", `${bits().most.toFixed(0)} bits`);
    const notes = Object.entries(layers.LAYERS)
      .filter(([name]) => $(`layer-${name}`).checked)
      .map(([, layer]) => layer(context, frame));
    tell("layers-say", notes.filter(Boolean).join(" "));
    layers.selection(context, frame);
    if (isShown("pixel")) layers.pixel(context, state.pixel.map((share) => share * side));
  }

  // --- bits -------------------------------------------------------------------------------------
  /** The bits of the file's anchors, and each anchor's share between the least and the most. */
  function bits() {
    if (state.bits) return state.bits;
    const each = requantise.anchorBits(state.model);
    const [least, most] = [Math.min, Math.max].map((end) => each.reduce((a, b) => end(a, b)));
    const share = (a) => (most > least ? (each[a] - least) / (most - least) : 0.5);
    return (state.bits = { each, least, most, share });
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

  /** Bytes of all networks, which no lambda changes. */
  const networkBytes = ({ bytes }) =>
    total(Object.keys(p4dgs.NETWORKS).map((section) => bytes[section] ?? 0));

  /** What a section holds, as the page says it. */
  const holds = (name) => $(`holds-${name}`).textContent;

  function drawStrip() {
    $("section-says").textContent = ""; // its bytes may have changed
    const sizes = Object.entries(withContainer((state.changed ?? state.model).bytes));
    const { header } = state.model;
    $("file-says").replaceChildren(
      element("bdi", {}, state.name),
      `: ${whole(state.data.length)} bytes, ${whole(header.anchors)} anchors with up to ` +
        `${header.k} children`,
    );
    $("strip").replaceChildren(...sizes.map(partOf));
  }

  /** One section of the strip: as wide as its bytes. */
  function partOf([name, size], i) {
    const share = percent(size, state.data.length);
    const said = `${i + 1} ${name}: ${whole(size)} bytes, ${share}. ${holds(name)}`;
    const names = { title: said, "aria-label": said, "aria-pressed": "false", "data-part": name };
    const button = element("button", names, element("span", {}, String(i + 1)));
    button.style.flex = `${size} 1 0.8rem`;
    button.addEventListener("click", () => {
      for (const one of $("strip").children) one.setAttribute("aria-pressed", one === button);
      $("section-says").textContent = said;
    });
    return button;
  }

  // --- requantising -----------------------------------------------------------------------------
  const BROKEN = ["weight", "frequency", "no-context"];

  const changes = () => ({
    coarser: 2 ** Number($("coarser").value),
    context: !$("no-context").checked,
    sign: state.sign,
    weight: $("weight").checked,
    frequency: $("frequency").checked,
  });

  function change() {
    const how = changes();
    const isSame = Object.entries(requantise.UNCHANGED).every(([key, v]) => how[key] === v);
    state.changed = isSame ? null : requantise.requantise(state.model, how);
    $("coarser-now").value = String(Number(how.coarser.toPrecision(2)));
    drawStrip();
    compare();
    ask();
  }

  function undo() {
    state.sign = null;
    $("coarser").value = "0";
    for (const id of BROKEN) $(id).checked = false;
    change();
    if (state.selected !== null) ownNumber();
  }

  /** A picture of a model for the comparison, on the processor. */
  function small(model) {
    const seen = cameraOf(state, COMPARED);
    return draw.onProcessor(draw.see(model, seen, time()).splats, draw.settings(model, seen));
  }

  /** Tells bytes and PSNR of the changed file. */
  function compare() {
    $("reset").disabled = !state.changed;
    $("trio").hidden = !state.changed;
    $("result").textContent = "Nothing is changed.";
    if (!state.changed) return;
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
      `PSNR of this view at t = ${time().toFixed(2)} against the unchanged file: ${quality}.`;
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

  const compareSoon = later(compare, 500);

  /** Flips a sign of the hash grid, or flips it back. */
  function flip(sign) {
    state.sign = state.sign === sign ? null : sign;
    change();
    ownNumber();
  }

  // --- one anchor -------------------------------------------------------------------------------
  function select(anchor) {
    state.selected = anchor;
    $("anchor").value = anchor === null ? "" : String(anchor);
    state.explained = null;
    $("anchor-shown").hidden = $("bell-shown").hidden = anchor === null;
    if (anchor !== null) listNumbers();
    ask();
    explainSoon(); // also while time runs
  }

  // --- one number -------------------------------------------------------------------------------
  const BELL = ["mu", "sigma", "q"];

  /** The numbers of the selected anchor that are in the file; the bell of the first one. */
  function listNumbers() {
    const all = explain.columnsOf(state.model);
    const isCoded = ({ column }) => requantise.isCoded(state.model, state.selected, column);
    const option = ({ label, column }) => element("option", { value: String(column) }, label);
    $("number").replaceChildren(...all.filter(isCoded).map(option));
    ownNumber();
  }

  /** The bell as it is in the file. */
  function ownNumber() {
    const { model, selected } = state;
    const own = explain.numberOf(model, current(), selected, Number($("number").value));
    const reach = Math.max(4 * own.sigma, 2 * Math.abs(own.v - own.mu), 4 * own.q);
    state.number = { ...own, reach };
    for (const name of BELL) $(`bell-${name}`).value = "0";
    drawBell();
  }

  function drawBell() {
    const { v, mu, sigma, q, reach } = state.number;
    const [shift, ...powers] = BELL.map((name) => Number($(`bell-${name}`).value));
    const now = { v, mu: mu + shift * reach, sigma: sigma * 2 ** powers[0], q: q * 2 ** powers[1] };
    for (const name of BELL) $(`bell-${name}-now`).value = explain.digits(now[name]);
    $("bell").replaceChildren(...explain.bell(now, { middle: mu, reach }));
  }

  /** The pictures and tables of the selected anchor, if the camera or the time has changed. They
   *  show the file, not the requantised one. */
  function explainAnchor() {
    const { frame, selected, model } = state;
    if (selected === null || !frame || state.explained === frame) return;
    state.explained = frame;
    const from = (_, i) => cameraOf({ ...state, azimuth: (360 * i) / WALK }, 1);
    const around = Array.from({ length: WALK + 1 }, from);
    $("anchor-look").replaceChildren(...explain.look(model, selected, around));
    const [own, now] = [model, current()].map((one) => explain.steps(one, selected));
    tell("steps-say", `Its steps q: ${now}${now === own ? "" : ` (in the file: ${own})`}.`);
    const read = { model: current(), selected, level: Number($("level").value) };
    $("signs").replaceChildren(...explain.signs(read, flip));
    if (!isShown("anchor-tables")) return; // the guide does not show them
    const scrolled = [...$("anchor-tables").children].map(({ scrollTop }) => scrollTop);
    const [seen, t] = [frame.camera, frame.t];
    const drawn = { model, camera: seen, t, ...draw.see(model, seen, t) };
    const tables = explain.anchor(drawn, selected, 8 * state.data.length);
    $("anchor-tables").replaceChildren(...tables);
    tables.forEach((table, i) => (table.scrollTop = scrolled[i] ?? 0));
  }

  const explainSoon = later(explainAnchor, 120);

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
   *  too long or another file is opened; then the promise is never kept. Where the browser starts
   *  no worker for a page from disk, the page decodes the file itself. */
  async function decoded(data) {
    end();
    try {
      return await inWorker(data);
    } catch (error) {
      if (error instanceof DOMException) return p4dgs.decode(data);
      throw error;
    } finally {
      end();
    }
  }

  const inWorker = (data) =>
    new Promise((resolve, reject) => {
      const url = URL.createObjectURL(
        new Blob([p4dgs.source, DECODE], { type: "text/javascript" }),
      );
      const worker = new Worker(url);
      const late = new Error(`decoding takes more than ${PATIENCE} seconds`);
      const timer = setTimeout(() => reject(late), 1000 * PATIENCE);
      $("progress").hidden = false;
      end = () => {
        $("progress").hidden = true;
        clearTimeout(timer);
        worker.terminate();
        URL.revokeObjectURL(url);
      };
      worker.onmessage = ({ data: { model, said } }) =>
        model ? resolve(model) : reject(new Error(said));
      worker.onerror = () => reject(new DOMException("no worker"));
      worker.postMessage(data);
    });

  /** Says in one line why a file is not shown. The previous scene stays. */
  function refuse(name, said) {
    const stays = state.model ? ` The previous scene, ${state.name}, is still shown.` : "";
    $("message").replaceChildren(element("bdi", {}, name), `: ${said}.${stays}`);
  }

  /** Shows a model and the bytes that it comes from, if it is small enough for this page. */
  function load(name, data, model) {
    const large = draw.tooLarge(model);
    if (large) {
      refuse(name, large);
      return;
    }
    if (chosen()?.data !== data) listOwn(name, data);
    const size = state.model ? homeDistance(state.model) : Infinity;
    Object.assign(state, { name, data, model, bits: null, changed: null });
    Object.assign(state, { fewer: 1, spent: 0 });
    $("message").textContent = "";
    $("all").hidden = false; // the controls need a scene
    if (Math.abs(homeDistance(model) - size) > 0.2 * size || size === Infinity) home();
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
    showRate();
    document.dispatchEvent(new Event("opened"));
  }

  let request = 0; // files so far; the last one requested is shown, whichever is decoded last

  /** Shows a file, whose bytes `read` promises. */
  async function open(name, read) {
    const own = ++request;
    $("message").textContent = "";
    try {
      const data = await read();
      const model = own === request && (await decoded(data));
      if (own === request) load(name, data, model);
    } catch (error) {
      if (own === request) refuse(name, error.message);
    }
  }

  /** Shows a file of the visitor. */
  function openFile(file) {
    if (!file) return;
    open(file.name, async () => {
      const isLarge = file.size > MOST_BYTES;
      if (isLarge) throw new Error("container, byte 10: expected at most 2^29 bytes");
      return new Uint8Array(await file.arrayBuffer());
    });
  }

  const decodeBase64 = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const held = JSON.parse($("files").textContent);
  const files = held.map((one) => ({ ...one, data: decodeBase64(one.base64) })); // and one's own
  const chosen = () => files[$("scene").selectedIndex];

  /** Shows the file that is chosen. */
  function openChosen() {
    const file = chosen();
    if (file) open(file.name, () => file.data);
  }

  function listFiles() {
    const said = ({ name, data }) => `\u2068${name}\u2069, ${whole(data.length)} bytes`; // as <bdi>
    $("scene").replaceChildren(...files.map((file) => element("option", {}, said(file))));
    $("scene").hidden = files.length < 2;
  }

  /** The visitor's file is the last one of the list. */
  function listOwn(name, data) {
    files[held.length] = { name, data, isOwn: true };
    listFiles();
    $("scene").selectedIndex = held.length;
  }

  // --- files of other lambda --------------------------------------------------------------------
  const rates = files.filter((file) => "lambda_rate" in file);
  rates.sort((one, other) => one.lambda_rate - other.lambda_rate);
  const visited = new Set();

  /** The curve through the files that were visited, and what this one is. */
  function showRate() {
    const file = chosen();
    if (!rates.includes(file)) return;
    visited.add(file);
    $("rate").max = String(rates.length - 1);
    $("rate").value = String(rates.indexOf(file));
    $("rate-now").value = String(file.lambda_rate);
    const fixed = networkBytes(state.model);
    const size = file.data.length;
    $("curve").replaceChildren(explain.curve(rates, visited, file, fixed));
    $("rate-says").textContent =
      `${whole(size)} bytes: ${whole(fixed)} for networks, ${whole(size - fixed)} for the rest. ` +
      `PSNR against the true pictures of the test views: ${file.psnr_db.toFixed(1)} dB.`;
  }

  // --- controls ---------------------------------------------------------------------------------
  function play(isPlaying) {
    state.playing = isPlaying;
    state.phase = time();
    $("play").setAttribute("aria-pressed", String(isPlaying));
    $("play").textContent = isPlaying ? "❚❚ Pause" : "▶ Play";
    ask();
  }

  /** What a key does while the picture has the focus. */
  function keys() {
    const arrow = (right, down) => (isShifted) =>
      isShifted ? pan(20 * right, 20 * down) : turn(5 * right, -5 * down);
    return {
      ArrowLeft: arrow(-1, 0),
      ArrowRight: arrow(1, 0),
      ArrowUp: arrow(0, -1),
      ArrowDown: arrow(0, 1),
      "+": () => zoom(0.9),
      "=": () => zoom(0.9),
      "-": () => zoom(1 / 0.9),
      " ": () => play(!state.playing),
      Home: home,
      Escape: () => select(null),
    };
  }

  function setTime(t) {
    $("time").value = String(t);
    play(false);
    moving();
  }

  /** The picture fills the screen, or the window where the browser does not give it the screen. */
  async function fullScreen() {
    const isFull = $("view").classList.toggle("full");
    $("full").setAttribute("aria-pressed", String(isFull));
    try {
      if (isFull) await $("view").requestFullscreen();
      else if (document.fullscreenElement) await document.exitFullscreen();
    } catch {
      // the class alone fills the window
    }
  }

  /** Mouse and touch: one pointer turns, two zoom and move, a short one selects. */
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
      const from = event.buttons && down.get(event.pointerId); // a menu can swallow the release
      if (!from || !state.model) return;
      const was = down.size === 2 ? apart() : 0;
      const [x, y] = [event.clientX, event.clientY];
      down.set(event.pointerId, { x, y });
      const [right, below] = [x - from.x, y - from.y];
      moved += Math.hypot(right, below);
      if (down.size === 2) {
        zoom(was / Math.max(apart(), 1));
        pan(right / 2, below / 2); // each finger moves the middle by half of its way
      } else if (event.shiftKey) pan(right, below);
      else turn(-0.5 * right, 0.5 * below);
    });
    // The browser scrolls the page by upright swipes of one finger, but not by two fingers.
    const two = (event) => event.touches.length > 1 && event.preventDefault();
    stage.addEventListener("touchstart", two, { passive: false });
    const up = (event) => {
      const isClick = event.type === "pointerup" && moved < 5 && down.has(event.pointerId);
      down.delete(event.pointerId);
      if (!isClick || !state.frame) return;
      const box = stage.getBoundingClientRect();
      const [u, v] = [event.clientX - box.left, event.clientY - box.top];
      if (isShown("pixel")) {
        state.pixel = [u / box.width, v / box.height];
        ask();
      } else select(layers.nearest(state.frame, u, v));
    };
    for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, up);
    const wheel = (event) => {
      const isOurs = event.ctrlKey || document.activeElement === stage;
      if (!isOurs && !$("view").classList.contains("full")) return;
      event.preventDefault();
      if (state.model) zoom(Math.exp(clip(event.deltaY, -200, 200) / 1000));
    };
    stage.addEventListener("wheel", wheel, { passive: false });
  }

  function controls() {
    const on = (id, event, call) => $(id).addEventListener(event, call);
    on("open", "change", () => {
      openFile($("open").files[0]);
      $("open").value = ""; // so that the same file can be opened again
    });
    on("play", "click", () => play(!state.playing));
    on("home", "click", home);
    on("time", "pointerdown", () => play(false));
    on("time", "input", () => setTime(time()));
    on("full", "click", fullScreen);
    document.addEventListener("fullscreenchange", () => {
      if (!document.fullscreenElement && $("view").classList.contains("full")) fullScreen();
    });
    on("scene", "change", openChosen);
    on("rate", "input", () => {
      $("scene").selectedIndex = files.indexOf(rates[Number($("rate").value)]);
      openChosen();
    });
    on("splats", "input", () => {
      const { value, max } = $("splats");
      state.painted = value === max ? Infinity : Number(value);
      ask();
    });
    on("number", "change", ownNumber);
    for (const name of BELL) on(`bell-${name}`, "input", drawBell);
    on("bell-own", "click", ownNumber);
    for (const id of ["shown", "layers", "level", "size", "canvas-path"]) on(id, "change", ask);
    const changeSoon = later(change, 30);
    for (const id of ["coarser", ...BROKEN]) on(id, "input", changeSoon);
    on("reset", "click", undo);
    on("anchor", "change", () => {
      const { value, max } = $("anchor");
      select(value === "" ? null : clip(Math.round(Number(value)), 0, Number(max)));
    });
    const known = keys();
    on("stage", "keydown", (event) => {
      const call = !event.ctrlKey && !event.metaKey && !event.altKey && known[event.key];
      if (!call || !state.model) return;
      event.preventDefault();
      call(event.shiftKey);
    });
    pointers($("stage"));
    for (const name of ["dragover", "dragleave", "drop"]) document.addEventListener(name, dropping);
    new ResizeObserver(ask).observe($("stage"));
  }

  /** A file may be dropped anywhere. */
  function dropping(event) {
    event.preventDefault();
    document.body.classList.toggle("dropping", event.type === "dragover");
    if (event.type === "drop") openFile(event.dataTransfer.files[0]);
  }

  /** Puts the picture into a state; what `settings` leave out is as a file is opened. */
  function arrange(settings) {
    const { shown = "scene", checked = [], stays, painted, turning } = settings;
    const { playing = stays && state.playing } = settings;
    undo();
    if (!stays) home();
    $("shown").value = shown;
    $("level").selectedIndex = 0;
    for (const box of $("layers").querySelectorAll("input")) box.checked = false;
    for (const id of checked) $(id).checked = true;
    change();
    if (!stays) setTime(0.3);
    select(null);
    state.painted = painted ?? Infinity;
    state.turning = Boolean(turning);
    play(Boolean(playing));
  }

  openGlass();
  controls();
  listFiles();
  if (!files.length) $("message").textContent = "Open a .p4dgs file, or drop one on this page.";
  Object.assign(exported, { state, paint, arrange, aim, play, setTime, bits, change, whole });
  Object.assign(exported, { homeDistance, cameraOf, openChosen, chosen, rates, networkBytes });
  Object.assign(exported, { select, ask, later });
})((globalThis.page = {}));
