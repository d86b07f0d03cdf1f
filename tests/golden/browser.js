// Opens the viewer's page in headless Chromium: `node tests/golden/browser.js FOLDER`.
//
// Writes a page with `p4dgs-ref view`, lets `browser_driver.js` use every control of it, with and
// without WebGL2, and compares pictures with those of `p4dgs-ref render`. Then it photographs the
// page at three widths, light and dark, and the layers one after another. Prints what was found;
// the exit code is 1 where something is wrong. It runs `chromium`, and `python` of the environment,
// or what the variables CHROMIUM and PYTHON name.
"use strict";

const { spawnSync } = require("child_process");
const { mkdirSync, readFileSync, readdirSync, writeFileSync } = require("fs");
const { join, resolve } = require("path");

const ROOT = resolve(__dirname, "..", "..");
const FOLDER = resolve(process.argv[2]);
const DEMO = join(ROOT, "tutorials", "demo.p4dgs");
const FLAGS = ["--headless=new", "--no-sandbox", "--enable-logging=stderr"];
const PATHS = {
  WebGL2: "--enable-unsafe-swiftshader",
  "no WebGL: canvas path": "--disable-3d-apis",
};
const WIDTHS = [400, 800, 1600];
const THEMES = { dark: 0, light: 1 }; // as Chromium numbers what a page is told of the wish

const at = (name) => join(FOLDER, name);
const base64 = (bytes) => Buffer.from(bytes).toString("base64");

function run(program, options) {
  const most = { cwd: ROOT, maxBuffer: 2 ** 28, timeout: 900_000, encoding: "utf8" };
  const { stdout, stderr, error } = spawnSync(program, options, most);
  if (error) throw error;
  return { stdout, stderr };
}

const chromium = (...options) => run(process.env.CHROMIUM ?? "chromium", [...FLAGS, ...options]);
const command = (line) =>
  run(process.env.PYTHON ?? "python", ["-m", "p4dgs_ref", ...line.split(" ")]);

/** What the driver compares with: pictures of the test views, and other files. */
function checks() {
  command(`render ${DEMO} --scene bouncing --settings exact -o ${at("views")}`);
  command(`train bouncing --preset smoke --set anchors=5000 --quiet -o ${at("large")}`);
  command(`encode ${at("large")} -o ${at("large.p4dgs")}`);
  const frames = readFileSync(join(ROOT, "tiny_scenes/bouncing/transforms_test.json"), "utf8");
  const names = readdirSync(at("views")).sort();
  const views = JSON.parse(frames);
  const images = names.map((name) => base64(readFileSync(join(at("views"), name))));
  const data = readFileSync(DEMO);
  const damaged = Buffer.from(data);
  damaged[4000] ^= 1;
  const bad = { "damaged.p4dgs": damaged, "foreign.p4dgs": "GIF89a".repeat(50) };
  for (const name of Object.keys(bad)) bad[name] = base64(bad[name]);
  const streams = join(ROOT, "p4dgs_ref", "codec", "streams_v1");
  const rows = JSON.parse(readFileSync(join(streams, "manifest.json"), "utf8")).good;
  const good = rows.map(({ file }) => [file, base64(readFileSync(join(streams, file)))]);
  return { views, images, bad, good, large: base64(readFileSync(at("large.p4dgs"))) };
}

/** What the page's console says, without how slow it is to read a software's picture. */
const consoleOf = (stderr) =>
  stderr.split("\n").filter((line) => line.includes("CONSOLE") && !line.includes("GPU stall"));

mkdirSync(FOLDER, { recursive: true });
command(`view ${DEMO} -o ${at("viewer.html")}`);
const script = readFileSync(join(__dirname, "browser_driver.js"), "utf8");
const data = `<script type="application/json" id="checks">${JSON.stringify(checks())}</script>`;
const page = readFileSync(at("viewer.html"), "utf8");
const driven = page.replace("</body>", () => `${data}<script>${script}</script></body>`);
writeFileSync(at("driver.html"), driven);

const wrong = [];
for (const [path, option] of Object.entries(PATHS)) {
  const { stdout, stderr } = chromium(option, "--dump-dom", at("driver.html"));
  const text = stdout.match(/<pre id="found">(.*?)<\/pre>/s)[1];
  const { layers, ...found } = JSON.parse(Buffer.from(text, "base64").toString());
  wrong.push(...found.wrong, ...consoleOf(stderr));
  if (found.path !== path) wrong.push(`the path is ${found.path}, expected ${path}`);
  layers.forEach((png, i) => writeFileSync(at(`layer_${i}.png`), Buffer.from(png, "base64")));
  console.log(JSON.stringify(found, null, 1));
}
for (const width of WIDTHS) {
  for (const [name, number] of Object.entries(THEMES)) {
    const options = [`--screenshot=${at(`${width}_${name}.png`)}`, `--window-size=${width},3000`];
    options.push(`--blink-settings=preferredColorScheme=${number}`, "--virtual-time-budget=3000");
    chromium(...options, at("viewer.html"));
  }
}
console.log(wrong.join("\n") || "nothing is wrong");
process.exitCode = wrong.length ? 1 : 0;
