// The coach: advice, the learning curve beside a typical one, and the last episodes.

import { colour, line, sharp } from "./scene.js";

const byId = (id) => document.getElementById(id);
const LEVELS = [0, 0.5, 1];
const [LEFT, RIGHT, TOP, BOTTOM] = [38, 2, 8, 18]; // around the curves, in pixels
const LEAST_S = 30; // of the human's time, from left to right
let shown = "";

// ``coach`` is null where there is none; as in trainer/person/coach.py.
export function showCoach(coach) {
  const text = JSON.stringify(coach) + byId("curve").clientWidth;
  if (text === shown) return;
  shown = text;
  byId("advice").textContent = coach?.advice ?? "";
  byId("coach").hidden = !coach?.said;
  byId("listed").hidden = !coach?.episodes.length;
  if (!coach) return;
  byId("alone").textContent = coach.alone;
  byId("given").textContent = coach.said;
  if (!byId("coach").hidden) drawCurves(byId("curve"), coach);
  const head = row(["episode", "outcome", "you, s", "take-overs"], "th");
  const rows = [...coach.episodes].reverse().map(({ number, outcome, human_s, takeovers }) =>
    row([number + 1, outcome, human_s.toFixed(1), takeovers], "td", outcome));
  byId("episodes").replaceChildren(head, ...rows);
}

function row(values, kind, outcome = "") {
  const element = document.createElement("tr");
  element.dataset.outcome = outcome;
  element.replaceChildren(...values.map((value) => {
    const cell = document.createElement(kind);
    cell.textContent = value;
    return cell;
  }));
  return element;
}

function drawCurves(canvas, { curve, typical, human_s }) {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const pen = sharp(canvas, width, height);
  pen.clearRect(0, 0, width, height);
  const end = Math.max(LEAST_S, human_s, ...[...curve, ...typical].map(([x]) => x));
  const at = ([x, y]) =>
    [LEFT + ((width - LEFT - RIGHT) * x) / end, TOP + (height - TOP - BOTTOM) * (1 - y)];
  const quiet = colour("quiet");
  pen.font = "11px system-ui, sans-serif";
  pen.fillStyle = quiet;
  for (const level of LEVELS) {
    line(pen, [at([0, level]), at([end, level])], "#3a424d", 1);
    pen.textAlign = "right";
    pen.fillText(`${100 * level}%`, LEFT - 4, at([0, level])[1] + 4);
  }
  pen.fillText(`${end.toFixed(0)} s of you`, width - RIGHT, height - 4);
  line(pen, [at([human_s, 0]), at([human_s, 1])], colour("human"), 1.5);
  line(pen, typical.map(at), quiet, 1.5);
  line(pen, curve.map(at), colour("policy"), 2);
  pen.fillStyle = colour("policy");
  for (const [x, y] of curve.map(at)) pen.fillRect(x - 2, y - 2, 4, 4);
  pen.textAlign = "left";
  const keys = [["policy", "alone", curve], ["quiet", "typical", typical], ["human", "now", [0]]];
  let x = LEFT;
  for (const [name, word] of keys.filter(([, , points]) => points.length)) {
    pen.fillStyle = colour(name);
    pen.fillText(word, x, height - 4);
    x += pen.measureText(word).width + 10;
  }
}
