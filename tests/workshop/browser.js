// Opens the viewer's page in headless Chromium: `node tests/workshop/browser.js FOLDER [guide]`.
//
// First it walks through the guide of `tutorials/viewer/demo.html` in windows of three sizes, light
// and dark, checks what a visitor can do by keys, fingers and links, and photographs every step.
// Then it writes a page with `p4dgs-ref view`, lets `browser_driver.js` use every control of it,
// with and without WebGL2, and compares pictures with those of `p4dgs-ref render`. It also measures
// frames per second and the time to the first picture. Prints what was found; the exit code is 1
// where something is wrong. With the word `guide` it does the first part alone, without photographs
// and in two windows. It runs `chromium`, and `python` of the environment, or what the variables
// CHROMIUM and PYTHON name.
"use strict";

const { spawnSync } = require("child_process");
const { mkdirSync, readFileSync, readdirSync, writeFileSync } = require("fs");
const { join, resolve } = require("path");
const { pathToFileURL } = require("url");
const devtools = require("./devtools.js");

const ROOT = resolve(__dirname, "..", "..");
const FOLDER = resolve(process.argv[2]);
const isQuick = process.argv[3] === "guide";
const DEMO = join(ROOT, "tutorials", "demo.p4dgs");
const CANVAS = "no WebGL: canvas path";
const PATHS = { WebGL2: "--enable-unsafe-swiftshader", [CANVAS]: "--disable-3d-apis" };
const SIZES = [[1280, 800], [800, 1000], [400, 800]];
const THEMES = ["light", "dark"];

const at = (name) => join(FOLDER, name);
const base64 = (bytes) => Buffer.from(bytes).toString("base64");
const ours = (name) => String(pathToFileURL(join(ROOT, "tutorials", "viewer", name)));
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
const wrong = [];
const check = (said, isSo) => isSo || wrong.push(said);

// --- the browser --------------------------------------------------------------------------------
/** Runs `call` with a browser whose pages report their errors. */
async function withBrowser(flags, call) {
  const browser = await devtools.open(...flags);
  const error = ({ exceptionDetails: { exception, text } }) =>
    wrong.push(`page error: ${exception?.description ?? text}`);
  browser.on("Runtime.exceptionThrown", error);
  browser.on("Log.entryAdded", ({ entry: { level, text } }) =>
    check(`console: ${text}`, level !== "error" && !/Uncaught/.test(text)),
  );
  const source = `document.addEventListener("painted", () => (globalThis.first = performance.now()),
    { once: true });
    document.addEventListener("painted", () => (globalThis.painted = (globalThis.painted ?? 0) + 1));
    globalThis.$ = (id) => document.getElementById(id);
    globalThis.Worker = class extends Worker {
      constructor(url) {
        if (location.search === "?none") throw new DOMException("no workers from disk");
        super(url);
        globalThis.workers = (globalThis.workers ?? 0) + 1;
      }
    };`;
  await browser.send("Page.addScriptToEvaluateOnNewDocument", { source });
  await browser.send("Emulation.setFocusEmulationEnabled", { enabled: true });
  try {
    return await call(browser);
  } finally {
    await browser.close();
  }
}

async function window(browser, [width, height], { theme = "light", isStill = false } = {}) {
  const metrics = { width, height, deviceScaleFactor: 1, mobile: width < 500 };
  await browser.send("Emulation.setDeviceMetricsOverride", metrics);
  await browser.send("Emulation.setTouchEmulationEnabled", { enabled: width < 500 });
  const motion = isStill ? "reduce" : "no-preference";
  const features = { "prefers-color-scheme": theme, "prefers-reduced-motion": motion };
  await browser.send("Emulation.setEmulatedMedia", {
    features: Object.entries(features).map(([name, value]) => ({ name, value })),
  });
}

/** Opens a page, until its first picture is drawn; where only its behaviour matters, the pictures
 *  have few pixels, because a software draws them. */
async function show(browser, url, pixels = isQuick ? 64 : 512) {
  await browser.go(url);
  await until(browser, "globalThis.first !== undefined", `no picture: ${url}`);
  await browser.evaluate(`$("size").value = "${pixels}"; page.ask()`);
}

/** Waits until an expression of the page is true; what is wrong otherwise after some seconds. */
async function until(browser, expression, said, seconds = 15) {
  for (let i = 0; i < 20 * seconds; i++) {
    if (await browser.evaluate(`Boolean(${expression})`).catch(() => false)) return;
    await wait(50);
  }
  wrong.push(said);
}

async function press(browser, key, more = {}) {
  for (const type of ["keyDown", "keyUp"]) {
    const text = key.length === 1 && type === "keyDown" ? key : undefined;
    await browser.send("Input.dispatchKeyEvent", { type, key, text, ...more });
  }
}

async function photograph(browser, name, options = {}) {
  const { data } = await browser.send("Page.captureScreenshot", { format: "png", ...options });
  writeFileSync(at(name), Buffer.from(data, "base64"));
}

// --- the guide ----------------------------------------------------------------------------------
// What of the page is true in every step; `shown` are the panels beside the text.
const STEPS = [
  { name: "scene", shown: [], is: "page.state.playing && page.state.azimuth === 320" },
  {
    name: "children",
    shown: [],
    is: "$('shown').value === 'canonical' && page.state.selected === 29",
  },
  { name: "splatting", shown: ["pixel"], is: "$('pixel').querySelectorAll('.later').length > 0" },
  {
    name: "prediction",
    shown: ["anchor-look"],
    is: "page.state.turning && $('walker').style.left !== ''",
  },
  {
    name: "time",
    shown: [],
    is: "page.state.playing && $('layer-paths').checked && $('layer-motion').checked",
  },
  { name: "steps", shown: ["coarser", "result", "trio"], is: "Number($('coarser').value) > 0" },
  {
    name: "context",
    shown: ["result", "signs", "bell"],
    is: "$('signs').children.length === 16 && / bits/.test($('bell').innerText)",
  },
  { name: "bits", shown: ["coarser", "result", "strip", "bell"], is: "!$('legend').hidden" },
  {
    name: "break",
    shown: ["result", "trio", "weight", "frequency", "no-context"],
    is: "page.state.changed",
  },
  { name: "lambda", shown: ["curve"], is: "$('curve').querySelectorAll('circle').length === 1" },
];
const PANELS = [...new Set(STEPS.flatMap(({ shown }) => shown))];

/** Walks through the steps with the arrow keys. */
async function walk(browser, size, theme) {
  const name = `${size.join("x")}_${theme}`;
  await window(browser, size, { theme });
  await show(browser, ours("demo.html"));
  for (const [i, { name: step, shown, is }] of STEPS.entries()) {
    const said = `${name}, step ${step}`;
    await until(browser, `document.body.dataset.step === "${step}"`, `${said} is not reached`);
    await until(browser, is, `${said}: ${is}`);
    const found = await browser.evaluate(`(${look})(${JSON.stringify(PANELS)})`);
    const wanted = PANELS.filter((id) => shown.includes(id));
    check(`${said}: shows ${found.shown}`, String(found.shown) === String(wanted));
    check(`${said}: articles ${found.articles}`, String(found.articles) === String(i + 1));
    check(`${said}: the page is ${found.wide} pixels wide`, found.wide === size[0]);
    check(`${said}: "${found.text}"`, !/undefined|NaN/.test(found.text));
    if (size[0] > 1000) {
      check(`${said}: the picture has ${found.side} pixels`, found.side >= 620);
      await browser.evaluate("scrollTo(0, 1e6)");
      const top = await browser.evaluate("$('stage').getBoundingClientRect().top");
      check(`${said}: the picture scrolls away, to ${top}`, top >= 0);
      await browser.evaluate("scrollTo(0, 0)");
      check(`${said}: the paper is at ${found.paper}`, found.paper <= size[1]);
    } else {
      check(`${said}: the picture is ${found.side} pixels wide`, found.side >= 0.4 * size[1]);
      check(`${said}: the sentence ends at ${found.sentence}`, found.sentence <= size[1]);
      const places = `the slider ends at ${found.slider}, the text begins at ${found.article}`;
      check(`${said}: ${places}`, found.slider <= found.article);
    }
    if (!isQuick) await steady(browser, `${name}_${i + 1}_${step}.png`, size);
    await press(browser, "ArrowRight");
  }
  const step = () => browser.evaluate("document.body.dataset.step");
  check(`${name}: after the last step`, (await step()) === "lambda");
  await press(browser, "ArrowLeft");
  check(`${name}: no way back`, (await step()) === "break");
  if (isQuick) return;
  await browser.evaluate("$('to-explore').click()");
  await wait(500);
  await photograph(browser, `${name}_explore.png`, { captureBeyondViewport: true });
}

/** A photograph of the whole page, when what is slow has been drawn. */
async function steady(browser, name, [width, height]) {
  await wait(1200);
  const all = await browser.evaluate("document.documentElement.scrollHeight");
  const clip = { x: 0, y: 0, width, height: Math.max(all, height), scale: 1 };
  await photograph(browser, name, { captureBeyondViewport: true, clip });
}

/** What the page shows; it is run there. */
function look(panels) {
  const byId = (id) => document.getElementById(id);
  const isShown = (one) => one.getClientRects().length > 0;
  const articles = [...document.querySelectorAll("article")];
  const firstSentence = (article) => {
    const range = document.createRange();
    range.setStart(article, 0);
    range.setEndAfter(article.querySelector("p").firstChild);
    return range.getBoundingClientRect().bottom;
  };
  return {
    shown: panels.filter((id) => isShown(byId(id))),
    articles: articles.map((one, i) => (isShown(one) ? i + 1 : 0)).filter(Boolean),
    wide: document.documentElement.scrollWidth,
    side: byId("stage").clientWidth,
    paper: byId("about").getBoundingClientRect().bottom,
    sentence: firstSentence(articles.find(isShown)),
    slider: byId("time").getBoundingClientRect().bottom,
    article: articles.find(isShown).getBoundingClientRect().top,
    text: document.body.innerText,
  };
}

/** Another lambda: another file, seen from the same place, and a further point of the curve. */
async function lambdas(browser) {
  const { evaluate } = browser;
  await window(browser, SIZES[0]);
  await show(browser, `${ours("demo.html")}#step=lambda&camera=100,20,1,0,0,0`);
  const count = await evaluate("page.rates.length");
  check(`${count} files of other lambda`, count === 5);
  await evaluate(`(async () => {
    for (const value of [0, 2, 3, 4]) {
      $("rate").value = String(value);
      $("rate").dispatchEvent(new Event("input"));
      for (let i = 0; i < 100 && page.chosen() !== page.rates[value]; i++)
        await new Promise((done) => setTimeout(done, 50));
      await new Promise((done) => document.addEventListener("opened", done, { once: true }));
    }
  })()`);
  const drawn = "$('curve').querySelectorAll('circle').length === 5";
  await until(browser, drawn, "the curve lacks a point");
  check("another camera", Math.round(await evaluate("page.state.azimuth")) === 100);
  const said = await evaluate("$('rate-says').textContent");
  const right = /^36,\d+ bytes: 33,518 for networks.*true pictures.*: 2\d\.\d dB\.$/;
  check(`"${said}"`, right.test(said));
  const sizes = await evaluate("page.rates.map(({ data }) => data.length)");
  check(`bytes ${sizes}`, sizes.every((size, i) => i === 0 || size < sizes[i - 1]));
  await evaluate("$('previous').click()");
  const demo = "page.state.name === 'demo.p4dgs' && document.body.dataset.step === 'break'";
  await until(browser, demo, "another step shows the file of another lambda");
  await evaluate("document.querySelector('#steps [value=scene]').click()");
  const bytes = await evaluate("document.querySelector('[data-fact=bytes]').textContent");
  check(`step 1 says ${bytes} bytes`, bytes === (await evaluate("page.whole(page.state.data.length)")));
  const one = join(ROOT, "p4dgs_ref", "oracle", "streams_v1", "one_anchor.p4dgs");
  const data = base64(readFileSync(one));
  await show(browser, `${ours("demo.html")}#step=context`);
  await until(browser, "page.state.selected === 29", "the anchor is not that of the tutorials");
  await evaluate(`{ const dataTransfer = new DataTransfer();
    const bytes = Uint8Array.from(atob("${data}"), (letter) => letter.charCodeAt(0));
    dataTransfer.items.add(new File([bytes], "one.p4dgs"));
    document.dispatchEvent(new DragEvent("drop", { dataTransfer })); }`);
  await until(browser, "page.state.name === 'one.p4dgs'", "a file does not open");
  check("its anchor", (await evaluate("page.state.selected")) === 0);
  const option = await evaluate("$('scene').selectedOptions[0]?.text");
  check(`the list says ${option}`, option?.includes("one.p4dgs"));
}

/** Links: what they keep, and what is no value. */
async function links(browser) {
  const { evaluate } = browser;
  await window(browser, SIZES[0]);
  const seen = async (hash, page = ours("demo.html")) => {
    await show(browser, `${page}${hash}`);
    return evaluate(`(({ azimuth, name, playing, shift, model }) => ({
      step: document.body.dataset.step, t: $("time").value, azimuth, name, playing,
      shift: shift[2] / page.homeDistance(model) }))(page.state)`);
  };
  const found = await seen("#step=time&camera=100,-10,0.5,0,0,0.25&t=0.75");
  const wanted = { step: "time", t: "0.75", azimuth: 100, name: "demo.p4dgs", playing: false };
  for (const [key, value] of Object.entries(wanted)) {
    check(`a link: ${key} is ${found[key]}`, found[key] === value);
  }
  check(`a link: the shift is ${found.shift}`, Math.abs(found.shift - 0.25) < 1e-9);
  for (const bad of ["step=9&camera=1,2&t=7&file=9", "step=<b>&camera=a,b,c,d,e,f&t=&%", "x"]) {
    await evaluate(`location.hash = "step=prediction"`);
    await until(browser, "document.body.dataset.step === 'prediction'", "no step prediction");
    await evaluate(`location.hash = ${JSON.stringify(bad)}`);
    const said = `${bad} does not lead to the first step`;
    await until(browser, "document.body.dataset.step === 'scene' && page.state.playing", said);
  }
  const coarse = readFileSync(join(ROOT, "tutorials", "tour", "rate_times_100.p4dgs"));
  const two = { "coarse.p4dgs": coarse, "demo.p4dgs": readFileSync(DEMO) };
  const held = Object.entries(two).map(([name, data]) => ({ name, base64: base64(data) }));
  const viewer = join(ROOT, "tutorials", "viewer"); // from which the scripts are found
  const page = readFileSync(join(viewer, "demo.html"), "utf8")
    .replaceAll('src="', `src="${pathToFileURL(viewer)}/`);
  const filled = (text) => `id="files">${JSON.stringify(text)}</script>`;
  writeFileSync(at("two.html"), page.replace(/id="files">.*<\/script>/, filled(held)));
  const other = await seen("#step=children&file=2", String(pathToFileURL(at("two.html"))));
  const color = "[...document.querySelectorAll('[data-link]'), document.body].map(colorOf)";
  const colors = await evaluate(`(colorOf => ${color})((one) => getComputedStyle(one).color)`);
  check(`dead links have the colours ${colors}`, new Set(colors).size === 1);
  const dots = await evaluate("document.querySelectorAll('#steps [value]:not([hidden])').length");
  check(`${dots} steps without files of other lambda`, dots === 9);
  check(`file 2 is ${other.name}`, other.name === "demo.p4dgs" && other.step === "children");
  await evaluate("location.hash = 'step=context'");
  await until(browser, "document.body.dataset.step === 'context'", "the address is not followed");
  check("another file", (await evaluate("page.state.name")) === "demo.p4dgs");
  await evaluate("page.aim({ azimuth: 77 })");
  const length = await evaluate("history.length");
  await until(browser, "/step=context&file=2&camera=77,.*&t=/.test(location.hash)", "no address");
  check("the history grows", (await evaluate("history.length")) === length);
  const granted = { permissions: ["clipboardReadWrite", "clipboardSanitizedWrite"] };
  await browser.send("Browser.grantPermissions", granted);
  await evaluate("$('copy').click()");
  await until(browser, "$('copy').textContent === 'Copied'", "no link is copied");
  const copied = await evaluate("navigator.clipboard.readText()");
  check(`copied: ${copied}`, copied === (await evaluate("location.href")));
  await show(browser, ours("demo.html")); // in its folder, from which the links lead on
  const hrefs = await evaluate("[...document.querySelectorAll('[data-link]')].map((a) => a.href)");
  check(`links ${hrefs}`, hrefs.length === 3 && hrefs.every((href) => href.startsWith("file:")));
}

/** Of the three balls, and of what is behind them. */
async function surfaces(browser) {
  const { evaluate } = browser;
  await window(browser, SIZES[0]);
  await show(browser, `${ours("demo.html")}#step=children`, 128);
  await until(browser, "page.state.frame.camera.size[0] === 128", "no picture of 128 pixels");
  const found = await evaluate(`(() => {
    const { frame } = page.state;
    const isBehind = layers.behindSurface(frame);
    const order = p4dgs.frontToBack(frame.splats);
    const { image } = p4dgs.compositing(frame.splats, draw.settings(frame.model, frame.camera));
    const counts = [0, 0, 0];
    for (let i = 0; i < image.length; i += 3) {
      const pixel = [...image.slice(i, i + 3)];
      const most = Math.max(...pixel);
      const isVivid = pixel.filter((v) => 1.3 * v < most).length === 2 && most > 0.2;
      if (isVivid) counts[pixel.indexOf(most)] += 1;
    }
    return { counts, first: isBehind(order[0]), share: order.filter(isBehind).length / order.length };
  })()`);
  check(`pixels of the balls: ${found.counts}`, found.counts.every((count) => count > 250));
  const said = `${found.share} of the children are behind a surface`;
  check(said, !found.first && found.share > 0.2 && found.share < 0.8);
  await evaluate("location.hash = 'step=bits'");
  await until(browser, "$('strip').offsetParent", "no strip");
  const colors = await evaluate(`[...$("strip").children, $("play")].map((one) =>
    getComputedStyle(one).backgroundColor)`);
  const [plain] = colors.splice(-1);
  check(`the strip has the colours ${colors}`, colors.every((color) => color !== plain));
}

/** Keys, mouse and full screen; a mouse that drags with Shift moves the scene. */
async function hands(browser) {
  const { evaluate, send } = browser;
  await window(browser, SIZES[0]);
  await show(browser, ours("demo.html"));
  await evaluate("$('stage').focus()");
  const step = () => evaluate("document.body.dataset.step");
  const azimuth = await evaluate("page.state.azimuth");
  await press(browser, "ArrowRight");
  check("an arrow key on the picture", (await step()) === "scene");
  check("it turns nothing", (await evaluate("page.state.azimuth")) !== azimuth);
  await evaluate("$('time').focus()");
  await press(browser, "ArrowRight", { windowsVirtualKeyCode: 39 });
  check("an arrow key on the time", (await step()) === "scene");
  const mouse = (type, x, y, more) => send("Input.dispatchMouseEvent", { type, x, y, ...more });
  await evaluate("page.play(true)");
  const slider = await evaluate("$('time').getBoundingClientRect().toJSON()");
  const [x, y] = [slider.x + slider.width / 4, slider.y + slider.height / 2];
  await mouse("mousePressed", x, y, { button: "left", clickCount: 1 });
  await mouse("mouseReleased", x, y, { button: "left", clickCount: 1 });
  const chosen = await evaluate("$('time').value");
  await wait(1000);
  const later = await evaluate("$('time').value");
  check(`the time ${chosen} becomes ${later}`, later === chosen && Math.abs(chosen - 0.25) < 0.05);
  check("the picture plays on", !(await evaluate("page.state.playing")));
  await mouse("mousePressed", 300, 300, { button: "right", clickCount: 1 }); // for a menu
  const was = await evaluate("page.state.azimuth");
  await mouse("mouseMoved", 400, 330, { button: "none", buttons: 0 });
  const isHeld = (await evaluate("page.state.azimuth")) !== was;
  check("a button that nobody holds turns the scene", !isHeld);
  await mouse("mouseReleased", 400, 330, { button: "right", clickCount: 1 });
  const drag = async (modifiers) => {
    const left = { button: "left", modifiers, clickCount: 1 };
    await mouse("mousePressed", 300, 300, left);
    await mouse("mouseMoved", 360, 320, { ...left, buttons: 1 });
    await mouse("mouseReleased", 360, 320, left);
    return evaluate("({ shift: Math.hypot(...page.state.shift), azimuth: page.state.azimuth })");
  };
  const moved = await drag(8);
  const turned = await drag(0);
  check(`Shift moves by ${moved.shift}`, moved.shift > 0 && moved.shift === turned.shift);
  check("dragging does not turn", moved.azimuth !== turned.azimuth);
  await evaluate("$('home').click()");
  check("Home leaves the shift", (await evaluate("Math.hypot(...page.state.shift)")) === 0);
  for (const isMissing of [false, true]) {
    if (isMissing) await evaluate("$('view').requestFullscreen = undefined; 0");
    const click = { expression: "$('full').click()", userGesture: true };
    await send("Runtime.evaluate", click);
    await wait(700);
    const said = `full screen${isMissing ? " where there is none" : ""}`;
    const side = await evaluate("$('stage').clientWidth");
    check(`${said}: ${side} pixels`, side > 640);
    check(said, isMissing || (await evaluate("document.fullscreenElement === $('view')")));
    if (!isQuick && isMissing) await photograph(browser, "full_screen.png");
    await send("Runtime.evaluate", click);
    const isLeft = "$('stage').clientWidth < 640 && !document.fullscreenElement";
    await until(browser, isLeft, `${said} stays`);
    await wait(300); // the page hears of it later
  }
}

/** Where frames are slow, a picture has fewer pixels while it moves; a worker decodes the file. */
async function slowness(browser) {
  const { evaluate } = browser;
  await window(browser, SIZES[0]);
  await show(browser, `${ours("demo.html")}#step=children`, 512);
  check("no worker decodes", (await evaluate("workers")) === 1);
  await until(browser, "/ 512 px/.test($('corner').textContent)", "not all pixels at rest");
  await evaluate(`document.addEventListener("painted", () => (page.state.spent = 99));
    page.play(true)`);
  await until(browser, "/ 128 px/.test($('corner').textContent)", "slow frames keep their pixels");
  await evaluate("page.play(false)");
  await until(browser, "/ 512 px/.test($('corner').textContent)", "pixels stay away");
  await show(browser, ours("demo.html").concat("?none"));
  check("a worker", (await evaluate("globalThis.workers")) === undefined);
  const name = "\u202Efile<b>.p4dgs";
  await evaluate(`{ const dataTransfer = new DataTransfer();
    dataTransfer.items.add(new File(["GIF"], ${JSON.stringify(name)}));
    document.dispatchEvent(new DragEvent("drop", { dataTransfer })); }`);
  await until(browser, `$("message").querySelector("bdi")?.textContent === ${JSON.stringify(name)}`,
    "a name is not isolated");
}

/** Fingers: upright swipes scroll the page, others are the picture's. */
async function fingers(browser) {
  const { evaluate, send } = browser;
  await window(browser, SIZES[2]);
  await show(browser, ours("demo.html"));
  await evaluate("page.play(false)");
  const touch = (type, ...points) =>
    send("Input.dispatchTouchEvent", {
      type,
      touchPoints: points.map(([x, y], id) => ({ x, y, id })),
    });
  const swipe = async (from, by, count = 5) => {
    await touch("touchStart", ...from);
    for (let i = 1; i <= count; i++) {
      const share = i / count;
      const places = from.map(([x, y], n) => [x + share * by[n][0], y + share * by[n][1]]);
      await touch("touchMove", ...places);
    }
    await wait(200); // a finger that stands still gives the page no momentum
    await touch("touchEnd");
    await wait(200);
    return evaluate(`({ top: scrollY, azimuth: page.state.azimuth, far: page.state.distance,
      shift: Math.hypot(...page.state.shift) })`);
  };
  const before = await evaluate("({ azimuth: page.state.azimuth, far: page.state.distance })");
  const up = await swipe([[200, 400]], [[0, -200]]);
  check(`an upright swipe scrolls by ${up.top}`, up.top > 50);
  await evaluate("scrollTo(0, 0)");
  await until(browser, "scrollY === 0", "the page does not scroll back");
  const aside = await swipe([[300, 300]], [[-150, 5]]);
  check("a sideways swipe", aside.top === 0 && aside.azimuth !== before.azimuth);
  const apart = await swipe([[150, 300], [250, 300]], [[-60, -60], [60, -60]]);
  check("two fingers do not zoom", apart.far < before.far);
  const said = `two fingers move by ${apart.shift}, scroll by ${apart.top}`;
  check(said, apart.shift > 0 && apart.top === 0);
}

/** Wishes of the visitor: less motion, no scripts, paper. */
async function wishes(browser) {
  const { evaluate, send } = browser;
  await window(browser, SIZES[0], { isStill: true });
  await show(browser, ours("demo.html"));
  for (const [step, coarser] of [["scene", "0"], ["prediction", "0"], ["steps", "4"]]) {
    await evaluate(`location.hash = "step=${step}"`);
    await wait(300);
    const still = `!page.state.playing && !page.state.turning &&
      $("coarser").value === "${coarser}"`;
    await until(browser, still, `step ${step} moves`, 5);
  }
  const features = [{ name: "prefers-color-scheme", value: "dark" }];
  await send("Emulation.setEmulatedMedia", { media: "print", features });
  const color = await evaluate("getComputedStyle(document.body).color");
  check(`it prints in ${color}`, color === "rgb(23, 32, 43)");
  if (!isQuick) {
    const { data } = await send("Page.printToPDF", { printBackground: true });
    writeFileSync(at("print.pdf"), Buffer.from(data, "base64"));
  }
  await send("Emulation.setEmulatedMedia", { media: "" });
  await send("Emulation.setScriptExecutionDisabled", { value: true });
  await window(browser, SIZES[0]);
  await browser.go(ours("demo.html"));
  await send("Emulation.setScriptExecutionDisabled", { value: false });
  const said = await evaluate("document.body.innerText");
  check("no word of JavaScript", /switched off/.test(said));
  check("the texts are not shown", /9\. Break it/.test(said) && !/Pause|Keys:/.test(said));
  if (!isQuick) await photograph(browser, "no_script.png");
}

/** Frames per second while it plays, and milliseconds to the first picture. */
async function pace(browser, url) {
  await window(browser, SIZES[0]);
  await show(browser, url);
  const first = await browser.evaluate("Math.round(globalThis.first)");
  await wait(3000);
  const before = await browser.evaluate("globalThis.painted");
  await wait(3000);
  const frames = ((await browser.evaluate("globalThis.painted")) - before) / 3;
  const corner = await browser.evaluate("$('corner').textContent");
  return { first_picture_ms: first, frames_per_second: Number(frames.toFixed(1)), corner };
}

// --- the controls -------------------------------------------------------------------------------
function command(line) {
  const words = ["-m", "p4dgs_ref", ...line.split(" ")];
  const options = { cwd: ROOT, timeout: 900_000, encoding: "utf8" };
  const { error, status, stderr } = spawnSync(process.env.PYTHON ?? "python", words, options);
  if (error || status) throw error ?? new Error(stderr);
}

/** What the driver compares with: pictures of the test views, and other files. */
function checks() {
  command(`render ${DEMO} --scene bouncing -o ${at("views")}`);
  command(`train bouncing --preset smoke --set anchors=5000 --quiet --yes -o ${at("large")}`);
  command(`encode ${at("large")} -o ${at("large.p4dgs")}`);
  command(`view ${at("large.p4dgs")} -o ${at("large.html")}`);
  const frames = readFileSync(join(ROOT, "tiny_scenes/bouncing/transforms_test.json"), "utf8");
  const names = readdirSync(at("views")).sort();
  const views = JSON.parse(frames);
  const images = names.map((name) => base64(readFileSync(join(at("views"), name))));
  const data = readFileSync(DEMO);
  const damaged = Buffer.from(data);
  damaged[4000] ^= 1;
  const bad = { "damaged.p4dgs": damaged, "foreign.p4dgs": "GIF89a".repeat(50) };
  for (const name of Object.keys(bad)) bad[name] = base64(bad[name]);
  const streams = join(ROOT, "p4dgs_ref", "oracle", "streams_v1");
  const rows = JSON.parse(readFileSync(join(streams, "manifest.json"), "utf8")).good;
  const good = rows.map(({ file }) => [file, base64(readFileSync(join(streams, file)))]);
  return { views, images, bad, good, large: base64(readFileSync(at("large.p4dgs"))) };
}

async function main() {
  mkdirSync(FOLDER, { recursive: true });
  await withBrowser([PATHS[CANVAS]], async (browser) => {
    const windows = SIZES.flatMap((size) => THEMES.map((theme) => [size, theme]));
    for (const [size, theme] of isQuick ? [windows[0], windows[5]] : windows) {
      await walk(browser, size, theme);
    }
    for (const part of [lambdas, surfaces, links, hands, slowness, fingers, wishes]) await part(browser);
  });
  if (isQuick) return;
  const known = JSON.stringify(checks());
  const script = readFileSync(join(__dirname, "browser_driver.js"), "utf8");
  command(`view ${DEMO} -o ${at("viewer.html")}`);
  for (const [path, flag] of Object.entries(PATHS)) {
    await withBrowser([flag], async (browser) => {
      for (const name of ["viewer.html", "large.html"]) {
        console.log(path, name, await pace(browser, String(pathToFileURL(at(name)))));
      }
      await show(browser, `${pathToFileURL(at("viewer.html"))}#step=explore&t=0.3`);
      await browser.evaluate(`globalThis.checks = ${known}; 0`);
      const { layers, ...found } = await browser.evaluate(script);
      wrong.push(...found.wrong);
      check(`the path is ${found.path}, expected ${path}`, found.path === path);
      layers.forEach((png, i) => writeFileSync(at(`layer_${i}.png`), Buffer.from(png, "base64")));
      console.log(JSON.stringify(found, null, 1));
    });
  }
}

main()
  .catch((error) => wrong.push(String(error.stack)))
  .then(() => {
    console.log(wrong.join("\n") || "nothing is wrong");
    process.exitCode = wrong.length ? 1 : 0;
  });
