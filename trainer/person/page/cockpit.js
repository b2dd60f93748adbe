// The cockpit: joins the hands, the link to the trainer, and what is drawn.

import { FIELDS, Gamepads } from "./gamepad.js";
import { Keyboard, list, OFF, Pad, ways } from "./hands.js";
import { Link } from "./link.js";
import { drawFrames, drawPicture, drawScene, History } from "./scene.js";

const byId = (id) => document.getElementById(id);
const STEP_MS = 1000 / 60;
const STALE_MS = 1000; // without a view for this long, the page says that it waits
const WHO = {
  waiting: ["Nobody drives yet", "the trainer is starting"],
  lost: ["Connection lost", "you have let go; looking for the trainer"],
  over: ["The sitting is over", "the trainer's terminal says what is saved"],
  policy: ["The policy drives", "hold a key, the pad or a button to take over"],
  human: ["You drive", "let go to hand control back"],
  returning: ["Handing back", "the action returns to the policy's"],
};
const LINK = { connecting: "connecting", live: "connected", lost: "connection lost", over: "ended" };

let view = null;
let viewMs = 0;
let driving = true; // and not watching
let refused = false; // the hold began before this page was connected, or drove
const changed = () => link?.changed();
const wish = (word) => link?.wish(word);
const keyboard = new Keyboard(changed, wish);
const touch = new Pad(byId("pad"), byId("knob"), changed);
const choices = Object.keys(FIELDS).map((id) => [id, byId(id)]);
const gamepads = new Gamepads({ ...Object.fromEntries(choices), name: byId("pad-name") }, changed, wish);
// A finger has priority over a key, a key over a device that may lie idle. A hidden page gets no
// input events.
const hands = {
  now: () => document.hidden ? OFF
    : [touch, keyboard, gamepads].map((hand) => hand.now()).find((said) => said.engaged)
      ?? gamepads.now(),
};
const history = new History(byId("history"));
const frames = [...document.querySelectorAll("#frames canvas")];
const link = new Link(hands, { view: see, echo: hearEcho, state: showState });
let lastMs = performance.now();
setInterval(step, STEP_MS);
// A page without focus gets no keyup and no pointerup; under a context menu it gets no keyup.
for (const gone of ["blur", "pagehide", "visibilitychange"]) {
  addEventListener(gone, () => [touch, keyboard].forEach((hand) => hand.release()));
}
addEventListener("contextmenu", () => keyboard.release());
addEventListener("visibilitychange", () => view && show());

function step() {
  const now = performance.now();
  keyboard.step((now - lastMs) / 1000);
  gamepads.step();
  lastMs = now;
  touch.draw();
  bar("human", hands.now().action);
  bar("raw", gamepads.now().action);
  if (view && now - viewMs > STALE_MS && document.body.dataset.link === "live") {
    byId("message").textContent = view.message || "waiting for the trainer";
  }
}

function see(next) {
  if (next.scenario !== view?.scenario) enter(next);
  view = next;
  viewMs = performance.now();
  history.add(view);
  show();
}

// A hidden page gets no animation frames, and must not draw all missed views at once.
function show() {
  if (document.hidden) link.drew(view.number);
  else requestAnimationFrame(draw);
}

function enter({ scenario, controls }) {
  keyboard.controls = touch.controls = gamepads.controls = controls;
  gamepads.scenario = scenario;
  const { aside, along } = ways(controls);
  byId("scenario").textContent = scenario.replace("_", " ");
  byId("meaning").textContent = `${controls.names.join(", ")}: - ◂ ▸ +`;
  for (const [side, text] of [["plus", aside ? "right" : "up"], ["minus", aside ? "left" : "down"]]) {
    for (const word of document.querySelectorAll(`.${side}-word`)) word.textContent = text;
  }
  byId("pad").className = aside ? "level" : "upright";
  byId("pad").hidden = !aside && !along;
  byId("keys").replaceChildren(...help(controls).map(span));
  changed(); // a key may be down already
}

function draw() {
  link.drew(view.number);
  if (document.body.dataset.link !== "live") return;
  document.body.dataset.control = view.control;
  if (view.scene) drawScene(byId("scene"), view);
  else if (view.picture) drawPicture(byId("scene"), view.picture);
  byId("frames").parentElement.hidden = !view.frames;
  if (view.frames) drawFrames(frames, view.frames);
  history.draw();
  bar("policy", view.policy_action);
  bar("applied", view.applied_action);
  byId("place").textContent = `episode ${view.episode + 1}, ${view.time_s.toFixed(1)} s`;
  byId("speed-value").textContent = view.speed_mps?.toFixed(1) ?? "–";
  const way = view.goal_m === null ? "" : `${view.distance_m.toFixed(1)} of ${view.goal_m.toFixed(0)} m`;
  byId("distance").textContent = way;
  byId("progress").textContent = view.progress;
  byId("message").textContent = view.paused ? view.message || "paused" : view.message;
  document.querySelector("[data-wish=pause]").textContent = view.paused ? "Go on" : "Pause";
  showWho();
}

function showWho() {
  const control = document.body.dataset.control;
  let [who, why] = WHO[control];
  if (view?.policy_action === null && control === "policy") who = "Nobody drives";
  if (!driving) why = "you watch: another page has the wheel";
  if (!driving && control === "human") who = "Another page drives";
  if (refused) why = "what was held before does not count: let go, and press again";
  byId("who").textContent = who;
  byId("why").textContent = why;
}

function bar(name, action) {
  const element = document.querySelector(`.bar.${name}`);
  const known = action !== null && action !== undefined;
  const values = list(action);
  const track = element.querySelector("i");
  while (track.children.length < values.length) track.append(document.createElement("u"));
  const tell = name === "raw" ? "human" : name; // the colours of several actions
  [...track.children].forEach((fill, i) => {
    const value = values[i] ?? 0;
    if (values.length > 1) fill.style.background = `var(--${tell}-${i})`;
    fill.style.left = `${50 + Math.min(value, 0) * 50}%`;
    fill.style.width = `${Math.abs(value) * 50}%`;
    fill.style.top = `${(100 * i) / values.length}%`;
    fill.style.height = `${100 / values.length}%`;
  });
  element.querySelector("output").textContent = known ? values.map((v) => v.toFixed(2)).join(" ") : "–";
}

function hearEcho(echo) {
  ({ driving, refused } = echo);
  document.body.classList.toggle("watching", !driving);
  byId("trip").textContent = `${link.tripMs().toFixed(link.tripMs() < 10 ? 1 : 0)} ms`;
  showWho();
}

function showState(state) {
  if (document.body.dataset.link === state) return;
  document.body.dataset.link = state;
  byId("link").textContent = LINK[state];
  byId("message").textContent = state === "live" && !view ? "waiting for the trainer" : "";
  if (state === "live") {
    document.body.dataset.control = view?.control ?? "waiting";
    if (view) requestAnimationFrame(draw);
  } else {
    document.body.dataset.control = state;
    byId("trip").textContent = "";
  }
  showWho();
}

for (const button of document.querySelectorAll("[data-wish]")) {
  button.addEventListener("click", () => wish(button.dataset.wish));
}

byId("full-screen").hidden = !document.fullscreenEnabled; // as on iPhones
byId("full-screen").addEventListener("click", () => document.fullscreenElement
  ? document.exitFullscreen() : document.documentElement.requestFullscreen());

// What each key does, in parts between which a line may break.
function help({ keys, rest, names }) {
  const held = {};
  for (const [key, added] of Object.entries(keys)) {
    const words = list(added).map((more, i) => {
      const value = Number((list(rest)[i] + more).toPrecision(6));
      return `${names[i]} ${value < 0 ? "" : "+"}${value}`;
    }).join(", ");
    (held[words] ??= []).push(key[0].toUpperCase() + key.slice(1));
  }
  const what = Object.entries(held).map(([words, pressed]) => `${pressed.join(" / ")}: ${words}`);
  return ["hold to take over", ...what, "Space: hands off"];
}

function span(text) {
  const element = document.createElement("span");
  element.textContent = text;
  return element;
}
