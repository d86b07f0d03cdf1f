"""Opens the viewer's page in headless Chromium: `python -m tests.golden.browser FOLDER`.

Writes the page into a folder, uses every control by `browser.js`, compares pictures with those of
`render`, and photographs the page at three widths, light and dark. Prints what was found; the exit
code is 1 where something is wrong. `chromium` must be installed.
"""

import base64
import html
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import p4dgs_ref as p4
from p4dgs_ref.report import view

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "tutorials" / "demo.p4dgs"
CHROMIUM = ("chromium", "--headless=new", "--no-sandbox", "--enable-logging=stderr")
PATHS = {"WebGL2": "--enable-unsafe-swiftshader", "no WebGL: canvas path": "--disable-3d-apis"}
QUICKLY = "--virtual-time-budget=3000"  # the time of a photograph; nothing is measured in it
WIDTHS = (400, 800, 1600)
THEMES = {"dark": 0, "light": 1}  # as Chromium numbers what a page is told of its visitor's wish


def text(data):
    """Bytes as base64."""
    return base64.b64encode(data).decode()


def large(model, anchors=5000):
    """The file of a model whose anchors are repeated at other places of its box."""
    random = np.random.default_rng(0)
    chosen = random.integers(0, model.primitives, anchors)
    parts = {name: a[chosen] for name, a in model.anchors._asdict().items()}
    parts["x_a"] = random.uniform(*model.box, (anchors, 3))
    return p4.encode(replace(model, anchors=type(model.anchors)(**parts)))


def checks():
    """What `browser.js` compares with: pictures of the test views, and other files."""
    data = DEMO.read_bytes()
    model, views = p4.decode(data), []
    for v in p4.load_scene("bouncing").test:
        c = v.camera
        camera = {"W": c.R.ravel().tolist(), "T": c.T.tolist(), "size": [c.width, c.height]}
        camera |= {"focal": [c.f_x, c.f_y], "center": [c.c_x, c.c_y]}
        image = np.clip(model.render(c, v.time, p4.SETTINGS["exact"]), 0, 1).astype(np.float32)
        views.append({"camera": camera, "t": v.time, "image": text(image.tobytes())})
    bad = {"damaged.p4dgs": data[:4000] + b"?" + data[4001:], "foreign.p4dgs": b"GIF89a" * 50}
    bad = {name: text(bytes) for name, bytes in bad.items()}
    return {"views": views, "bad": bad, "large": text(large(model))}


def chromium(*options):
    """Run Chromium; what it wrote, and the lines of the page's console."""
    run = subprocess.run([*CHROMIUM, *options], capture_output=True, text=True, timeout=600)
    return run.stdout, re.findall(r"CONSOLE.*?\] (?!.*GPU stall)(.*)", run.stderr)


def main(folder):
    """Run all checks in both paths, then take the photographs."""
    page, driver = folder / "viewer.html", folder / "driver.html"
    view.view({DEMO: DEMO.read_bytes()}, page)
    script = (ROOT / "tests" / "golden" / "browser.js").read_text()
    more = f'<script type="application/json" id="checks">{json.dumps(checks())}</script>'
    driver.write_text(page.read_text().replace("</body>", f"{more}<script>{script}</script></body>"))
    wrong = []
    for path, option in PATHS.items():
        dom, console = chromium(option, "--dump-dom", str(driver))
        found = json.loads(html.unescape(re.search(r'<pre id="found">(.*?)</pre>', dom)[1]))
        wrong += [*found["wrong"], *console, *([] if found["path"] == path else [found["path"]])]
        print(json.dumps(found, indent=1))
    for width in WIDTHS:
        for name, number in THEMES.items():
            picture = f"--screenshot={folder / f'{width}_{name}.png'}"
            theme = f"--blink-settings=preferredColorScheme={number}"
            chromium(theme, picture, f"--window-size={width},2600", QUICKLY, str(page))
    print("\n".join(wrong) or "nothing is wrong")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
