// Uses every control of the page and writes what it finds into the document, as JSON.
//
// `browser.py` puts this script behind the page's own, and `checks` before it: views with the
// package's pictures of them, a damaged file and a file of 5,000 anchors.
"use strict";

(async function () {
  const { p4dgs, draw, page, layers, requantise } = globalThis;
  const $ = (id) => document.getElementById(id);
  const checks = JSON.parse($("checks").textContent);
  const found = { wrong: [] };
  const check = (said, isSo) => isSo || found.wrong.push(said);
  const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  // The browser writes out the document when it is loaded, and this empty frame is loaded last.
  const frame = document.body.appendChild(document.createElement("iframe")).contentDocument;
  frame.open();
  const wait = (ms) => new Promise((done) => setTimeout(done, ms));

  /** Until the page has drawn what was asked for. */
  const drawn = () =>
    new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));

  /** Gives a control a value, and waits until the page has drawn it. */
  async function use(id, value) {
    $(id)[typeof value === "boolean" ? "checked" : "value"] = value;
    for (const name of ["input", "change"]) $(id).dispatchEvent(new Event(name));
    await drawn();
  }

  async function press(key) {
    $("stage").focus();
    $("stage").dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
    await drawn();
  }

  async function drop(name, data) {
    const dataTransfer = new DataTransfer();
    dataTransfer.items.add(new File([data], name));
    document.dispatchEvent(new DragEvent("drop", { dataTransfer }));
    await wait(50);
    for (let i = 0; i < 100 && page.state.name !== name && !$("message").textContent; i++) {
      await wait(50);
    }
    await drawn();
  }

  const pixelsOf = (canvas) => {
    const copy = document.createElement("canvas");
    [copy.width, copy.height] = [canvas.width, canvas.height];
    copy.getContext("2d").drawImage(canvas, 0, 0);
    return copy.getContext("2d").getImageData(0, 0, copy.width, copy.height).data;
  };
  const picture = () => pixelsOf($("picture").hidden ? $("glass") : $("picture"));
  const isSame = (a, b) => a.length === b.length && a.every((v, i) => v === b[i]);

  // --- pictures ---------------------------------------------------------------------------------
  /** The largest difference from a picture of the package, [height, width, 3] float32. */
  function difference(pixels, wanted) {
    let most = 0;
    for (let i = 0; i < wanted.length / 3; i++) {
      for (let c = 0; c < 3; c++) {
        most = Math.max(most, Math.abs(pixels[4 * i + c] - 255 * wanted[3 * i + c]));
      }
    }
    return most;
  }

  function pictures() {
    const { model } = page.state;
    const glass = $("glass").hidden ? null : new draw.WebGL(document.createElement("canvas"));
    found.canvas = found.webgl = 0;
    for (const { camera, t, image } of checks.views) {
      const wanted = new Float32Array(bytesOf(image).buffer);
      const { splats } = draw.see(model, camera, t);
      const scene = draw.settings(model, camera);
      const flat = draw.onProcessor(splats, scene);
      found.canvas = Math.max(found.canvas, difference(flat, wanted));
      if (!glass) continue;
      glass.draw(splats, scene);
      found.webgl = Math.max(found.webgl, difference(glass.pixels(), wanted));
    }
    check(`canvas: ${found.canvas} of 255 from the package`, found.canvas <= 1);
    check(`WebGL2: ${found.webgl} of 255 from the package`, found.webgl <= 4);
  }

  /** Milliseconds a picture: the median of some, each at another time. */
  async function pace(isCanvas, count = 31) {
    await use("canvas-path", isCanvas);
    const spent = [];
    for (let i = 0; i < count; i++) {
      $("time").value = String(i / count);
      const start = performance.now();
      page.paint(start);
      if (!$("glass").hidden) pixelsOf($("glass")); // waits until it is drawn
      spent.push(performance.now() - start);
    }
    return spent.sort((a, b) => a - b)[Math.floor(count / 2)];
  }

  // --- everything a visitor can do --------------------------------------------------------------
  async function controls() {
    await use("masks", false); // some children are then below tau_alpha
    await wait(100);
    for (const name of Object.keys(layers.LAYERS)) {
      const before = pixelsOf($("above"));
      await use(`layer-${name}`, true);
      check(`the layer ${name} draws nothing`, !isSame(before, pixelsOf($("above"))));
      await use(`layer-${name}`, false);
      check(`the layer ${name} stays`, isSame(before, pixelsOf($("above"))));
    }
    $("reset").click();
    await drawn();
    for (const path of [false, true]) {
      await use("canvas-path", path);
      for (const what of ["canonical", "bits"]) {
        const before = picture();
        await use("shown", what);
        check(`${what} shows the same picture`, !isSame(before, picture()));
        await use("shown", "scene");
        check(`${what} stays`, isSame(before, picture()));
      }
      await use("shown", "scene");
    }
    await use("canvas-path", false);
    const at = $("time").value;
    $("play").click();
    await wait(600);
    check("it does not play", $("time").value !== at);
    $("play").click();
    await drawn();
    const still = $("time").value;
    await wait(300);
    check("it does not pause", $("time").value === still);
  }

  async function keysAndPointers() {
    const { state } = page;
    for (const key of ["ArrowLeft", "ArrowUp", "+", "-", ".", "1", "6"]) {
      const before = [picture(), pixelsOf($("above"))];
      await press(key);
      const now = [picture(), pixelsOf($("above"))];
      check(`the key ${key} does nothing`, !now.every((pixels, i) => isSame(pixels, before[i])));
    }
    for (const key of ["1", "6", "Home", "]"]) await press(key);
    check("the key ] selects no anchor", state.selected === 0);
    await press("Escape");
    const box = $("stage").getBoundingClientRect();
    const middle = [box.left + box.width / 2, box.top + box.height / 2];
    const [clientX, clientY] = middle;
    const pointer = { pointerId: 1, clientX, clientY, bubbles: true };
    $("stage").setPointerCapture = () => {}; // there is no such pointer
    const send = (name, more) =>
      $("stage").dispatchEvent(new PointerEvent(name, { ...pointer, ...more }));
    send("pointerdown");
    send("pointerup");
    await wait(300);
    check("a click selects no anchor", state.selected !== null);
    check("no tables of the anchor", $("anchor-tables").querySelectorAll("table").length === 4);
    const turned = state.azimuth;
    send("pointerdown");
    send("pointermove", { clientX: clientX + 60 });
    send("pointerup", { clientX: clientX + 60 });
    check("dragging does not turn", state.azimuth !== turned);
    const near = state.distance;
    $("stage").dispatchEvent(new WheelEvent("wheel", { deltaY: -300 }));
    check("the wheel does not zoom", state.distance < near);
    await press("Home");
    $("strip").children[3].click();
    check("a section says nothing", $("section-says").textContent.includes("bytes"));
  }

  async function coarser() {
    const { length } = page.state.data;
    const before = picture();
    for (const [id, value] of [["coarser", "2"], ["dropped", "1"], ["masks", false]]) {
      await use(id, value);
      await wait(100);
      check(`${id} changes nothing`, page.state.changed && !isSame(before, picture()));
      check(`${id} tells no PSNR`, / dB|no difference/.test($("result").textContent));
    }
    await use("context", false);
    await wait(100);
    const total = Object.values(page.state.changed.bytes).reduce((a, b) => a + b, 0);
    check(`${total} bytes of ${length}`, total > 0 && total < length);
    $("unchanged").click();
    await drawn();
    check("the unchanged file is not shown", isSame(before, picture()));
    $("reset").click();
    await drawn();
    check("changes stay", page.state.changed === null && isSame(before, picture()));
    const same = requantise.requantise(page.state.model, page.state.sections, {});
    check("no change moves bytes", Object.entries(same.bytes).every(isOwn));
  }

  const isOwn = ([name, size]) => size === page.state.model.bytes[name];

  async function otherFiles() {
    const { name, model } = page.state;
    for (const [file, data] of Object.entries(checks.bad)) {
      await drop(file, bytesOf(data));
      const said = $("message").textContent;
      found[file] = said;
      check(`${file}: ${said}`, /: .*, byte \d+: .*stays\.$/.test(said) && !said.includes("\n"));
      check(`${file} replaces the scene`, page.state.model === model && page.state.name === name);
    }
    const start = performance.now();
    await drop("large.p4dgs", bytesOf(checks.large));
    found.large_opened = Math.round(performance.now() - start);
    check("5,000 anchors do not open", page.state.model.header.anchors === 5000);
    check("the message stays", $("message").textContent === "");
    found.large_ms = Math.round(await pace(true, 3));
    for (const name of Object.keys(layers.LAYERS)) await use(`layer-${name}`, true);
    await use("shown", "bits");
    found.large_all_layers_ms = Math.round(await pace(true, 3));
    const huge = { ...page.state.model, header: { ...page.state.model.header, anchors: 2 ** 22 } };
    check("four million anchors are taken", draw.tooLarge(huge) !== null);
  }

  try {
    await wait(300);
    found.path = $("corner").textContent.split(" · ")[0];
    const start = performance.now();
    for (let i = 0; i < 10; i++) p4dgs.decode(page.state.data);
    found.decode = Math.round((performance.now() - start) / 10);
    pictures();
    found.canvas_ms = await pace(true);
    found.webgl_ms = await pace(false);
    check(`canvas: ${found.canvas_ms} ms a picture`, found.canvas_ms < 1000 / 15);
    await use("time", "0.3");
    await controls();
    await keysAndPointers();
    await coarser();
    await otherFiles();
  } catch (error) {
    found.wrong.push(String(error.stack));
  }
  document.body.append(Object.assign(document.createElement("pre"), { id: "found" }));
  $("found").textContent = JSON.stringify(found);
  frame.close();
})();
