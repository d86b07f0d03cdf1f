// The guided tour of a file, and the link that brings a visitor back to what they saw.
//
// Each step is an article of page.html, with its text and the state of the picture.
"use strict";

(function () {
  const { draw, page } = globalThis;
  const { state, whole } = page;
  const $ = (id) => document.getElementById(id);
  const all = (what) => document.querySelectorAll(what);

  const EXPLORE = "explore"; // the step in which all panels are shown
  const articles = new Map([...all("article")].map((one) => [one.dataset.steps, one]));
  if (page.rates.length < 2) articles.delete("lambda");
  const STEPS = [...articles.keys()];
  const PAUSE = 1800; // milliseconds for which steps q stay as coarse as they are

  let [step, last] = [STEPS[0], STEPS[0]]; // and the last one of the guide
  let coarsening = 0; // a timer

  const isStill = () => matchMedia("(prefers-reduced-motion: reduce)").matches;
  const seen = () => draw.see(state.model, page.cameraOf(state, 64), 0.5);

  // --- what the texts say of the file -----------------------------------------------------------
  const SEERS = {
    "": "none does",
    view_color: "only the one for colours does",
    view_geometry: "all but the one for colours do",
    "view_color,view_geometry": "all four do",
  };
  const FACTS = {
    bytes: () => whole(state.data.length),
    gaussians: () => whole(seen().gaussians.index.length),
    anchors: ({ header }) => whole(header.anchors),
    k: ({ header }) => whole(header.k),
    d: ({ header }) => whole(header.d),
    seers: ({ header }) => SEERS[header.effects.filter((name) => /^view_/.test(name)).sort()],
    least: () => page.bits().least.toFixed(0),
    most: () => page.bits().most.toFixed(0),
    context: ({ bytes }) => whole(bytes.hash_grid + bytes.context_mlps),
    networks: (model) => whole(page.networkBytes(model)),
  };

  const anchors = new WeakMap(); // of each model, the anchor that the steps explain

  /** The anchor whose visible children move the most. */
  function telling({ header }) {
    const { gaussians, moved } = seen();
    const [weights, x] = [new Float64Array(header.anchors), gaussians.x];
    gaussians.index.forEach((child, n) => {
      const way = Math.hypot(...[0, 1, 2].map((i) => moved.x_t[3 * n + i] - x[3 * n + i]));
      weights[Math.floor(child / header.k)] += gaussians.alpha[n] * (way + 1e-6);
    });
    return weights.indexOf(weights.reduce((a, b) => Math.max(a, b)));
  }

  // --- steps ------------------------------------------------------------------------------------
  /** Shows the panels of a step, and its state of the picture; Explore leaves that as it is. */
  function enter(to) {
    step = to;
    last = step === EXPLORE ? last : step;
    clearInterval(coarsening);
    document.body.dataset.step = step;
    for (const dot of all("#steps [value]")) {
      dot.setAttribute("aria-current", dot.value === step ? "step" : "false");
    }
    $("to-guide").setAttribute("aria-pressed", String(step !== EXPLORE));
    $("to-explore").setAttribute("aria-pressed", String(step === EXPLORE));
    $("previous").disabled = step === STEPS[0];
    $("next").disabled = step === STEPS.at(-1);
    if (state.model && step !== EXPLORE) arrange(articles.get(step));
    state.explained = null; // other panels are shown
    page.ask();
    addressSoon();
  }

  function arrange(article) {
    const { model } = state;
    for (const place of article.querySelectorAll("[data-fact]")) {
      place.textContent = FACTS[place.dataset.fact](model);
    }
    const { anchor, playing, turning, coarser, pixel, ...rest } = JSON.parse(article.dataset.show);
    const moves = !isStill();
    const moving = playing === undefined ? {} : { playing: playing && moves };
    page.arrange({ ...rest, ...moving, turning: turning && moves });
    if (!anchors.has(model)) anchors.set(model, page.chosen()?.anchor ?? telling(model));
    if (anchor) page.select(anchors.get(model));
    if (pixel) choosePixel(anchors.get(model));
    if (!coarser) return;
    let power = moves ? 0 : coarser; // steps q times 2^power, by itself; once if nothing may move
    const next = () => {
      $("coarser").value = String(power);
      power = (power + 1) % (coarser + 1);
      page.change();
    };
    next();
    if (moves) coarsening = setInterval(next, PAUSE);
  }

  /** The pixel of an anchor's first child. */
  function choosePixel(anchor) {
    const { model } = state;
    const camera = page.cameraOf(state, 1);
    const { gaussians, splats } = draw.see(model, camera, Number($("time").value));
    const n = gaussians.index.findIndex((child) => Math.floor(child / model.header.k) === anchor);
    if (n >= 0) state.pixel = [0, 1].map((i) => splats.mean2d[2 * n + i] + 0.5);
  }

  /** Goes to a step as the visitor asks. The files of other lambda stay in their step. */
  function visit(to) {
    const isLeft = step === "lambda" && to !== step && !page.chosen().isOwn;
    enter(to);
    if (!isLeft || !$("scene").selectedIndex) return;
    $("scene").selectedIndex = 0;
    page.openChosen();
  }

  const go = (by) => visit(STEPS[STEPS.indexOf(step) + by] ?? step);

  // --- the link ---------------------------------------------------------------------------------
  /** The address of what is seen. After # it has `step` (a name, or explore), `file` (its number
   *  where the page holds several), `camera` (azimuth and elevation in degrees; distance and shift
   *  in units of the first distance) and `t`. What it leaves out is as the step sets it: a
   *  camera that nobody moved, and a running time, unless the address is `exact`. */
  function address({ exact }) {
    const home = page.homeDistance(state.model);
    const { azimuth, elevation, distance, shift, isMoved, playing } = state;
    const view = [azimuth, elevation, ...[distance, ...shift].map((v) => v / home)];
    const fields = [`step=${step}`];
    const { length, selectedIndex } = $("scene");
    if (length > 1 && !page.chosen().isOwn) fields.push(`file=${selectedIndex + 1}`);
    if (exact || isMoved) fields.push(`camera=${view.map((v) => Number(v.toFixed(3)))}`);
    if (exact || !playing) fields.push(`t=${$("time").value}`);
    return `${location.href.split("#")[0]}#${fields.join("&")}`;
  }

  /** The address bar follows; the history gets no entry. */
  const addressSoon = page.later(() => history.replaceState(null, "", address({})), 500);

  async function copy() {
    try {
      await navigator.clipboard.writeText(address({ exact: true }));
      $("copy").textContent = page.chosen()?.isOwn ? "Copied, without your file" : "Copied";
    } catch {
      page.play(false); // the address bar then has the time, too
      $("copy").textContent = "See the address bar";
    }
    setTimeout(() => ($("copy").textContent = "Copy link"), 2500);
  }

  /** `n` if it is a whole number from 1 to `most`, else null. */
  const choice = (n, most) => (Number.isInteger(n) && n >= 1 && n <= most ? n : null);

  let isFollowed = false; // whether the scene shown is the one of the address

  /** Does what the address says. Invalid values count as left out. */
  function follow({ newURL = location.href }) {
    const fields = Object.fromEntries(new URLSearchParams(newURL.split("#")[1]));
    const numbers = (name) => (fields[name] ?? "").split(",").map(Number.parseFloat);
    const { length, selectedIndex } = $("scene");
    const file = (choice(numbers("file")[0], length) ?? selectedIndex + 1) - 1;
    isFollowed = Boolean(state.model) && file === selectedIndex;
    if (!isFollowed) {
      $("scene").selectedIndex = file;
      page.openChosen();
      return;
    }
    const { step: asked = STEPS[0] } = fields;
    const isExploring = asked === EXPLORE;
    enter(isExploring || STEPS.includes(asked) ? asked : STEPS[0]);
    if (isExploring) page.arrange({ playing: !isStill() });
    const [azimuth, elevation, ...far] = numbers("camera");
    const [distance, ...shift] = far.map((v) => v * page.homeDistance(state.model));
    const isCamera = [azimuth, elevation, ...far].every(Number.isFinite) && shift.length === 3;
    if (isCamera) page.aim({ azimuth, elevation, distance, shift });
    const [t] = numbers("t");
    if (t >= 0 && t <= 1) page.setTime(t);
  }

  // --- controls ---------------------------------------------------------------------------------
  function keys(event) {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    const isOther = event.ctrlKey || event.metaKey || event.altKey || event.shiftKey;
    const isTaken = event.defaultPrevented || event.target.closest("input, select, .scroll");
    if (by && !isOther && !isTaken && step !== EXPLORE) go(by);
  }

  for (const dot of all("#steps [value]")) {
    dot.hidden = !articles.has(dot.value);
    dot.addEventListener("click", () => visit(dot.value));
  }
  const calls = { previous: () => go(-1), next: () => go(1), copy };
  calls["to-guide"] = () => visit(last);
  calls["to-explore"] = () => visit(EXPLORE);
  for (const [id, call] of Object.entries(calls)) $(id).addEventListener("click", call);
  $("coarser").addEventListener("pointerdown", () => clearInterval(coarsening));
  document.addEventListener("keydown", keys);
  document.addEventListener("opened", () => (isFollowed ? enter(step) : follow({})));
  document.addEventListener("painted", addressSoon);
  addEventListener("hashchange", follow);
  // Files of the project stand beside its own pages alone.
  const isOurs = location.pathname.includes("/tutorials/viewer/");
  for (const link of isOurs ? all("[data-link]") : []) link.href = link.dataset.link;
  follow({});
})();
