// Uses every control of the page in Explore; its value is a promise of what it finds.
//
// `browser.js` runs this script in the page, whose `checks` it has set before: a scene's test views
// with the package's pictures of them, bad files, good ones of all kinds, one of 5,000 anchors.
(async function () {
  "use strict";
  const { p4dgs, draw, page, layers, explain, requantise, checks } = globalThis;
  const $ = (id) => document.getElementById(id);
  const found = { wrong: [], layers: [] };
  const check = (said, isSo) => isSo || found.wrong.push(said);
  const bytesOf = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const wait = (ms) => new Promise((done) => setTimeout(done, ms));

  /** Until something is so; at most some seconds. */
  async function until(isSo) {
    for (let i = 0; i < 100 && !isSo(); i++) await wait(50);
    return isSo();
  }

  /** Until the page has drawn what was asked for. */
  const drawn = () =>
    new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));

  /** Gives a control a value, and waits until the page has drawn it. */
  async function use(id, value) {
    $(id)[typeof value === "boolean" ? "checked" : "value"] = value;
    for (const name of ["input", "change"]) {
      $(id).dispatchEvent(new Event(name, { bubbles: true }));
    }
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
  /** The camera of a frame of a scene in the layout of D-NeRF: its axes y and z are turned. */
  function cameraOf({ transform_matrix: M }, { fl_x, fl_y, cx, cy }, size) {
    const turned = [1, -1, -1];
    const W = [0, 1, 2].flatMap((axis) => [0, 1, 2].map((i) => turned[axis] * M[i][axis]));
    const T = [0, 1, 2].map((axis) => {
      const row = W.slice(3 * axis, 3 * axis + 3);
      return -row.reduce((sum, w, i) => sum + w * M[i][3], 0);
    });
    return { W, T, focal: [fl_x, fl_y], center: [cx - 0.5, cy - 0.5], size };
  }

  /** How many of the 255 steps two pictures differ by at most. */
  const difference = (pixels, wanted) =>
    pixels.reduce((most, v, i) => Math.max(most, Math.abs(v - wanted[i])), 0);

  async function pictures() {
    const { model } = page.state;
    const glass = $("glass").hidden ? null : new draw.WebGL(document.createElement("canvas"));
    found.canvas = found.webgl = 0;
    for (const [i, frame] of checks.views.frames.entries()) {
      const image = new Image();
      image.src = `data:image/png;base64,${checks.images[i]}`;
      await image.decode();
      const wanted = pixelsOf(image);
      const camera = cameraOf(frame, checks.views, [image.width, image.height]);
      const { splats } = draw.see(model, camera, frame.time);
      const scene = draw.settings(model, camera);
      found.canvas = Math.max(found.canvas, difference(draw.onProcessor(splats, scene), wanted));
      if (!glass) continue;
      glass.draw(splats, scene);
      found.webgl = Math.max(found.webgl, difference(pixelsOf(glass.canvas), wanted));
    }
    check(`canvas: ${found.canvas} of 255 from the package`, found.canvas <= 1);
    check(`WebGL2: ${found.webgl} of 255 from the package`, found.webgl <= 4);
  }

  /** Milliseconds a picture, each at another time: the fastest, which nothing disturbed, and the
   *  median. */
  async function pace(isCanvas, count = 31) {
    await use("canvas-path", isCanvas);
    await use("size", "256");
    const spent = [];
    for (let i = 0; i < count; i++) {
      $("time").value = String(i / count);
      const start = performance.now();
      page.paint(start);
      if (!$("glass").hidden) pixelsOf($("glass")); // waits until it is drawn
      spent.push(performance.now() - start);
    }
    await use("size", "512");
    spent.sort((a, b) => a - b);
    return [spent[0], spent[Math.floor(count / 2)]].map(Math.round);
  }

  // --- everything a visitor can do --------------------------------------------------------------
  async function controls() {
    await wait(600); // a picture at rest has all its pixels
    for (const name of Object.keys(layers.LAYERS)) {
      const before = pixelsOf($("above"));
      await use(`layer-${name}`, true);
      check(`the layer ${name} draws nothing`, !isSame(before, pixelsOf($("above"))));
      await use(`layer-${name}`, false);
      check(`the layer ${name} stays`, isSame(before, pixelsOf($("above"))));
    }
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
    check("it does not play", await until(() => $("time").value !== at));
    $("play").click();
    await drawn();
    const still = $("time").value;
    await wait(300);
    check("it does not pause", $("time").value === still);
  }

  async function keysAndPointers() {
    const { state } = page;
    for (const key of ["ArrowLeft", "ArrowUp", "+", "-"]) {
      const before = picture();
      await press(key);
      check(`the key ${key} does nothing`, !isSame(before, picture()));
    }
    await press("Home");
    await use("anchor", "0");
    await press("Escape");
    check("Escape leaves an anchor", state.selected === null);
    const box = $("stage").getBoundingClientRect();
    const middle = [box.left + box.width / 2, box.top + box.height / 2];
    const [clientX, clientY] = middle;
    const pointer = { pointerId: 1, buttons: 1, clientX, clientY, bubbles: true };
    $("stage").setPointerCapture = () => {}; // there is no such pointer
    const send = (name, more) =>
      $("stage").dispatchEvent(new PointerEvent(name, { ...pointer, ...more }));
    send("pointerdown");
    send("pointerup");
    await wait(300);
    check("a click selects no anchor", state.selected !== null);
    check("no tables of the anchor", $("anchor-tables").querySelectorAll("table").length === 3);
    const turned = state.azimuth;
    send("pointerdown");
    send("pointermove", { clientX: clientX + 60 });
    send("pointerup", { clientX: clientX + 60 });
    check("dragging does not turn", state.azimuth !== turned);
    const far = state.distance;
    for (const [id, by] of [[1, -40], [2, 40]]) {
      send("pointerdown", { pointerId: id, clientX: clientX + by });
    }
    send("pointermove", { pointerId: 2, clientX: clientX + 120 });
    for (const id of [1, 2]) send("pointerup", { pointerId: id });
    check("two fingers do not zoom", state.distance < far);
    const near = state.distance;
    $("stage").dispatchEvent(new WheelEvent("wheel", { deltaY: -300 }));
    check("the wheel does not zoom", state.distance < near);
    await press("Home");
    $("strip").children[3].click();
    check("a section says nothing", $("section-says").textContent.includes("bytes"));
  }

  async function coarser() {
    const { length } = page.state.data;
    await use("time", "0.3");
    await wait(600);
    const before = picture();
    await use("coarser", "2");
    await wait(100);
    check("coarser changes nothing", page.state.changed && !isSame(before, picture()));
    check("coarser tells no PSNR", / dB/.test($("result").textContent));
    await use("no-context", true);
    await wait(100);
    const total = Object.values(page.state.changed.bytes).reduce((a, b) => a + b, 0);
    check(`${total} bytes of ${length}`, total > 0 && total < length);
    $("reset").click();
    for (const id of ["weight", "frequency"]) {
      await use(id, true);
      await wait(400);
      check(`${id} changes nothing`, !isSame(before, picture()));
      await use(id, false);
      await wait(400);
    }
    check("changes stay", page.state.changed === null && isSame(before, picture()));
    const same = requantise.requantise(page.state.model, {});
    check("no change moves bytes", Object.entries(same.bytes).every(isOwn));
  }

  /** The figures of the guide that react: splats of a pixel, signs of the grid, a bell. */
  async function figures() {
    const step = (name) => document.querySelector(`#steps [value=${name}]`).click();
    const { state } = page;
    step("splatting");
    await use("splats", $("splats").max);
    const all = picture();
    for (const share of [0, 0.5]) {
      await use("splats", String(Math.round(share * Number($("splats").max))));
      check(`${share} of the splats give the whole picture`, !isSame(all, picture()));
    }
    const rests = [];
    for (const share of [0, 0.15, 0.2, 0.25, 0.3, 0.5, 1]) {
      const count = Math.round(share * Number($("splats").max));
      await use("splats", String(count));
      const { splats, model, camera } = state.frame;
      const { transmittance } = p4dgs.compositing(splats, draw.settings(model, camera));
      const [u, v] = state.pixel.map((share) => Math.round(share * camera.size[0] - 0.5));
      const rest = Number(/background gets ([-\d.]+)/.exec($("pixel").innerText)[1]);
      const gap = rest - transmittance[v * camera.size[0] + u];
      check(`${count} splats leave ${rest} and ${gap}`, Math.abs(gap) < 0.01);
      rests.push(rest);
    }
    check(`the pixel is left ${rests}`, rests[0] === 1 && rests.at(-1) < 0.1);
    const before = $("pixel").innerText;
    const box = $("stage").getBoundingClientRect();
    const [clientX, clientY] = [box.left + box.width / 3, box.top + box.height / 2];
    const pointer = { pointerId: 1, buttons: 1, clientX, clientY, bubbles: true };
    $("stage").setPointerCapture = () => {}; // there is no such pointer
    for (const name of ["pointerdown", "pointerup"]) {
      $("stage").dispatchEvent(new PointerEvent(name, pointer));
    }
    await drawn();
    check("a click chooses no pixel", $("pixel").innerText !== before);
    step("context");
    const ownSteps = explain.steps(state.model, state.selected);
    await until(() => $("steps-say").textContent.includes(ownSteps));
    const [steps, said] = [$("steps-say").textContent, $("bell").innerText];
    $("signs").firstChild.click();
    check("a sign changes no step", await until(() => $("steps-say").textContent !== steps));
    check("a sign changes no bell", $("bell").innerText !== said);
    check("a sign changes no bytes", / bytes/.test($("result").textContent));
    $("signs").firstChild.click();
    check("a sign stays flipped", await until(() => $("steps-say").textContent === steps));
    check("a change stays", !state.changed && $("bell").innerText === said);
    step("bits");
    await drawn();
    const own = requantise.bitsOfAnchor(state.model, state.selected)[0];
    const bits = () => Number(/([\d.]+) bits/.exec($("bell").innerText)[1]);
    check(`the bell says ${bits()} bits, not ${own}`, Math.abs(bits() - own) < 0.01);
    for (const [name, value] of [["mu", "0.5"], ["sigma", "1"], ["q", "1"]]) {
      await use(`bell-${name}`, value);
      check(`the bell ignores ${name}`, Math.abs(bits() - own) > 0.1);
      $("bell-own").click();
      check(`the bell keeps ${name}`, Math.abs(bits() - own) < 0.01);
    }
    $("to-explore").click();
    await use("shown", "scene");
  }

  /** The stage with each layer, as PNG in base64, its name below: pictures for an animation. */
  async function photographs() {
    await press("Escape");
    const shots = [photograph("The scene")];
    for (const { id } of document.querySelectorAll("#layers input")) {
      await use(id, true);
      await use("anchor", /grid|families/.test(id) ? "29" : ""); // the one of the tutorials
      shots.push(photograph(document.querySelector(`label[for=${id}]`).textContent));
      await use(id, false);
    }
    await press("Escape");
    await use("shown", "bits");
    shots.push(photograph("Bits of each anchor"));
    await use("shown", "scene");
    return shots;
  }

  const SIDE = 320;

  function photograph(caption) {
    const canvas = Object.assign(document.createElement("canvas"), { width: SIDE });
    canvas.height = SIDE + 28;
    const context = canvas.getContext("2d");
    context.fillStyle = "white";
    context.fillRect(0, 0, canvas.width, canvas.height);
    for (const part of [$("picture").hidden ? $("glass") : $("picture"), $("above")]) {
      context.drawImage(part, 0, 0, SIDE, SIDE);
    }
    context.fillStyle = "#17202b";
    context.font = "16px sans-serif";
    context.fillText(caption, 10, SIDE + 19);
    return canvas.toDataURL("image/png").split(",")[1];
  }

  const isOwn = ([name, size]) => size === page.state.model.bytes[name];

  async function otherFiles() {
    const { name, model } = page.state;
    for (const [file, data] of Object.entries(checks.bad)) {
      await drop(file, bytesOf(data));
      const said = $("message").textContent;
      found[file] = said;
      check(`${file}: ${said}`, /: .*, byte \d+: .*is still shown\.$/.test(said) && !said.includes("\n"));
      check(`${file} replaces the scene`, page.state.model === model && page.state.name === name);
    }
    check("the port's script is not where workers look", $("files").nextElementSibling.text);
    const start = performance.now();
    await drop("large.p4dgs", bytesOf(checks.large));
    found.large_opened = Math.round(performance.now() - start);
    check("5,000 anchors do not open", page.state.model.header.anchors === 5000);
    check("the message stays", $("message").textContent === "");
    found.large_ms = await pace(true, 3);
    for (const name of Object.keys(layers.LAYERS)) await use(`layer-${name}`, true);
    await use("shown", "bits");
    found.large_all_layers_ms = await pace(true, 3);
    for (const [file, data] of checks.good) {
      await drop(file, bytesOf(data));
      await use("anchor", "0");
      await use("level", String(page.state.model.header.grid.length - 1));
      await use("coarser", "3");
      await wait(100);
      check(`${file} does not open`, page.state.name === file && page.state.changed);
      check(`${file} is not in the list`, $("scene").selectedOptions[0]?.text.includes(file));
      for (const dot of document.querySelectorAll("#steps [value]:not([hidden])")) {
        dot.click();
        await drawn();
        check(`${file}, step ${dot.value}`, !/undefined|NaN/.test(document.body.innerText));
      }
      $("to-explore").click();
    }
    found.good = checks.good.length;
    const huge = { ...page.state.model, header: { ...page.state.model.header, anchors: 2 ** 22 } };
    check("four million anchors are taken", draw.tooLarge(huge) !== null);
  }

  try {
    await wait(300);
    found.path = $("corner").textContent.split(" · ")[0];
    const start = performance.now();
    for (let i = 0; i < 10; i++) p4dgs.decode(page.state.data);
    found.decode = Math.round((performance.now() - start) / 10);
    await pictures();
    found.canvas_ms = await pace(true);
    found.webgl_ms = await pace(false);
    check(`canvas: ${found.canvas_ms[0]} ms a picture`, found.canvas_ms[0] < 1000 / 15);
    await use("time", "0.3");
    await controls();
    await keysAndPointers();
    await coarser();
    await figures();
    found.layers = await photographs();
    await otherFiles();
  } catch (error) {
    found.wrong.push(String(error.stack));
  }
  return found;
})();
