// Drawing: the road from above, the policy's frames, and the last ten seconds of actions.

const COLOURS = {
  ground: "#1d2823",
  road: "#3d444d",
  marking: "#aab2bb",
  path: "rgba(97, 175, 239, 0.65)",
  goal: "#54c878",
  traffic: "#eb8c28",
  glass: "rgba(10, 12, 15, 0.75)",
};
// The colours of policy and human are the same in every view: colours.css has them.
const colour = (name) => getComputedStyle(document.body).getPropertyValue(`--${name}`);
const [WIDTH_M, HEIGHT_M, VIEW] = [46, 25, [-30, -7]]; // as in trainer/scenarios/picture.py
const GOAL_HALF_M = 2.0;
const HISTORY_STEPS = 100;

// Size a canvas for the screen's resolution; return its context, scaled to CSS pixels.
function sharp(canvas, width, height) {
  const ratio = devicePixelRatio || 1;
  const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  return pen;
}

// The upper left corner of the view, m: the scene's own, or around an ego car that has left it.
function corner({ view, vehicles }) {
  const [left, top] = VIEW;
  const inside = ({ x, y }) => x >= left && x <= left + WIDTH_M && y >= top && y <= top + HEIGHT_M;
  const lost = vehicles.find((car) => car.ego && !inside(car));
  return view ?? (lost ? [lost.x - WIDTH_M / 2, lost.y - HEIGHT_M / 2] : VIEW);
}

export function drawScene(canvas, view) {
  // An environment's scene may leave out any of it.
  const scene = { roads: [], road_width_m: 4, path: [], vehicles: [], ...view.scene };
  const [left, top] = corner(scene);
  const width = canvas.clientWidth;
  const scale = width / WIDTH_M;
  const pen = sharp(canvas, width, HEIGHT_M * scale);
  pen.fillStyle = COLOURS.ground;
  pen.fillRect(0, 0, width, HEIGHT_M * scale);
  pen.scale(scale, scale); // metres from here on
  pen.translate(-left, -top);
  pen.lineJoin = "round";
  for (const road of scene.roads) line(pen, road, COLOURS.road, scene.road_width_m);
  for (const marking of scene.lane_lines ?? []) dashes(pen, marking, 0);
  if (!scene.lane_lines) {
    for (const road of scene.roads) dashes(pen, road, scene.road_width_m / 2);
  }
  line(pen, scene.path, COLOURS.path, 0.22);
  if (scene.goal) {
    const [x, y] = scene.goal;
    line(pen, [[x, y - GOAL_HALF_M], [x, y + GOAL_HALF_M]], COLOURS.goal, 0.5);
  }
  for (const car of scene.vehicles) drawCar(pen, car, view.control);
}

// Draw the picture, a JPEG in base64, of an environment without a scene.
export function drawPicture(canvas, base64) {
  const image = new Image();
  image.onload = () => {
    const width = canvas.clientWidth;
    const height = (width * image.height) / image.width;
    sharp(canvas, width, height).drawImage(image, 0, 0, width, height);
  };
  image.src = `data:image/jpeg;base64,${base64}`;
}

function line(pen, points, colour, width) {
  pen.beginPath();
  for (const [x, y] of points) pen.lineTo(x, y);
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.stroke();
}

// 2 m on, 2 m off, leaving out what lies nearer to the origin than skip (the crossing).
function dashes(pen, [[x0, y0], [x1, y1]], skip) {
  const length = Math.hypot(x1 - x0, y1 - y0);
  const at = (m) => [x0 + ((x1 - x0) * m) / length, y0 + ((y1 - y0) * m) / length];
  for (let m = 0; m < length; m += 4) {
    const ends = [at(m), at(m + 2)];
    if (ends.every(([x, y]) => Math.max(Math.abs(x), Math.abs(y)) >= skip)) {
      line(pen, ends, COLOURS.marking, 0.12);
    }
  }
}

function drawCar(pen, car, control) {
  const [length, width] = [car.length_m, car.width_m];
  pen.save();
  pen.translate(car.x, car.y);
  pen.rotate(car.heading_rad);
  pen.shadowColor = "rgba(0, 0, 0, 0.5)";
  pen.shadowBlur = 6;
  pen.fillStyle = car.ego ? colour(control) : COLOURS.traffic;
  pen.beginPath();
  pen.roundRect(-length / 2, -width / 2, length, width, 0.45);
  pen.fill();
  pen.shadowBlur = 0;
  pen.fillStyle = COLOURS.glass;
  pen.fillRect(0.1 * length, -0.4 * width, 0.16 * length, 0.8 * width);
  pen.fillRect(-0.38 * length, -0.36 * width, 0.08 * length, 0.72 * width);
  pen.restore();
}

export function drawFrames(canvases, base64) {
  const bytes = atob(base64);
  canvases.forEach((canvas, number) => {
    const count = canvas.width * canvas.height;
    const image = new ImageData(canvas.width, canvas.height);
    for (let i = 0; i < count; i++) {
      image.data.fill(bytes.charCodeAt(number * count + i), 4 * i, 4 * i + 3);
      image.data[4 * i + 3] = 255;
    }
    canvas.getContext("2d").putImageData(image, 0, 0);
  });
}

export class History {
  constructor(canvas) {
    this.canvas = canvas;
    this.steps = [];
  }

  add(view) {
    if (view.paused) return;
    this.steps.push([view.policy_action, view.applied_action, view.control]);
    if (this.steps.length > HISTORY_STEPS) this.steps.shift();
  }

  draw() {
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const pen = sharp(this.canvas, width, height);
    pen.clearRect(0, 0, width, height);
    const dx = width / HISTORY_STEPS;
    const left = width - this.steps.length * dx;
    const y = (action) => height / 2 - action * (height / 2 - 3);
    this.steps.forEach(([, , control], i) => {
      if (control === "policy") return;
      pen.fillStyle = colour(control);
      pen.globalAlpha = 0.22;
      const [from, to] = [Math.round(left + i * dx), Math.round(left + (i + 1) * dx)];
      pen.fillRect(from, 0, to - from, height);
      pen.globalAlpha = 1;
    });
    line(pen, [[0, height / 2], [width, height / 2]], "#3a424d", 1);
    const trace = (index, name, wide) => {
      const known = this.steps.map((step, i) => [left + (i + 0.5) * dx, step[index]]);
      const points = known.filter(([, action]) => action !== null);
      [].concat(points[0]?.[1] ?? []).forEach((_, n) => {
        const places = points.map(([x, action]) => [x, y([].concat(action)[n])]);
        line(pen, places, colour(`${name}-${n}`), wide);
      });
    };
    trace(0, "policy", 1.2);
    trace(1, "applied", 2);
  }
}
