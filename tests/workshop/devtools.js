// Headless Chromium, driven by its DevTools protocol over a pipe: no package, no port, no server.
"use strict";

const { spawn } = require("child_process");
const { mkdtempSync, rmSync } = require("fs");
const { tmpdir } = require("os");
const { join } = require("path");

/** A browser with one page: `send` calls a method of the protocol, `on` hears its events. */
function open(...flags) {
  const profile = mkdtempSync(join(tmpdir(), "p4dgs-browser-"));
  const own = ["--headless=new", "--no-sandbox", "--remote-debugging-pipe", "--hide-scrollbars"];
  const options = [...own, `--user-data-dir=${profile}`, ...flags, "about:blank"];
  const stdio = ["ignore", "ignore", "ignore", "pipe", "pipe"];
  const browser = spawn(process.env.CHROMIUM ?? "chromium", options, { stdio });
  const [input, output] = [browser.stdio[3], browser.stdio[4]];
  const waiting = new Map(); // calls without an answer
  const listeners = new Map();
  let [calls, session, rest] = [0, undefined, []];

  function send(method, params = {}) {
    const id = ++calls;
    input.write(`${JSON.stringify({ id, method, params, sessionId: session })}\0`);
    return new Promise((resolve, reject) => waiting.set(id, { method, resolve, reject }));
  }

  function hear({ id, method, params, result, error }) {
    if (id === undefined) {
      listeners.get(method)?.(params);
      return;
    }
    const call = waiting.get(id);
    waiting.delete(id);
    if (error) call.reject(new Error(`${call.method}: ${error.message}`));
    else call.resolve(result);
  }

  output.on("data", (data) => {
    const parts = data.toString("latin1").split("\0"); // no character is cut in two
    rest.push(parts.shift());
    while (parts.length) {
      hear(JSON.parse(Buffer.from(rest.join(""), "latin1").toString()));
      rest = [parts.shift()];
    }
  });

  async function attach() {
    const { targetInfos } = await send("Target.getTargets");
    const { targetId } = targetInfos.find(({ type }) => type === "page");
    ({ sessionId: session } = await send("Target.attachToTarget", { targetId, flatten: true }));
    for (const domain of ["Page", "Runtime", "Log"]) await send(`${domain}.enable`);
  }

  /** The value of an expression in the page; of a promise, what it is kept with. */
  async function evaluate(expression) {
    const asked = { expression, awaitPromise: true, returnByValue: true };
    const { result, exceptionDetails } = await send("Runtime.evaluate", asked);
    if (exceptionDetails) throw new Error(exceptionDetails.exception.description);
    return result.value;
  }

  /** Opens an address, until the page is loaded. */
  async function go(url) {
    const loaded = new Promise((done) => listeners.set("Page.loadEventFired", done));
    await send("Page.navigate", { url: "about:blank" });
    await loaded;
    const again = new Promise((done) => listeners.set("Page.loadEventFired", done));
    await send("Page.navigate", { url });
    await again;
  }

  function close() {
    const gone = new Promise((done) => browser.on("exit", done));
    browser.kill("SIGKILL");
    return gone.then(() => rmSync(profile, { recursive: true, force: true, maxRetries: 5 }));
  }

  const on = (event, call) => listeners.set(event, call);
  return attach().then(() => ({ send, on, evaluate, go, close }));
}

module.exports = { open };
