import { $, act, definitions, get, h, listJobs, nextSteps, number, on, request, start, submit, toast, when } from "./rig.js";
import "./pictures.js";
import "./shelf.js";

const STATES = ["disconnected", "connected", "unreferenced", "ready", "moving", "stopped", "fault"];
let gyro = null; // the angle of the table by the gyro, after the last move
let tableDeg = null;

// -- the dial ----------------------------------------------------------------------------------------------------------------

/** Turn the needles of the dial: 0° is at the top, angles grow counter-clockwise, as the table's do seen from above. */
function dial(status) {
  const angle = status.table_deg;
  const [low, high] = status.limits_deg || [-360, 360];
  const known = angle !== null && angle !== undefined;
  tableDeg = known ? angle : null;
  for (const [id, degrees] of [["needle", angle], ["gyro", gyro]]) {
    $(id).toggleAttribute("hidden", !known || degrees === null);
    $(id).setAttribute("transform", `rotate(${-degrees} 200 200)`);
  }
  const used = known ? Math.min(Math.abs(angle) / Math.max(Math.abs(angle < 0 ? low : high), 1), 1) : 0;
  $("used").setAttribute("stroke-dasharray", `${used} 1`);
  $("used").setAttribute("transform", `translate(200 200) rotate(-90) scale(1 ${angle < 0 ? 1 : -1}) translate(-200 -200)`);
  $("used").classList.toggle("much", used > 0.9);
  const moving = status.servo && status.servo.moving ? ` at ${number(status.velocity_dps, 0)} °/s` : "";
  $("dial-text").textContent = known ? `${number(angle, 2)}°${moving}` : "angle in doubt";
}

const target = h("line", { id: "target", x1: 200, y1: 200, x2: 200, y2: 52 });
let wanted = null;

function aim(degrees) {
  wanted = degrees;
  if (degrees === null) return target.remove();
  if (!target.isConnected) $("needle").before(target);
  target.setAttribute("transform", `rotate(${-degrees} 200 200)`);
  $("dial").setAttribute("aria-valuenow", degrees.toFixed(0));
  $("dial").setAttribute("aria-valuetext", `${number(degrees, 0)}°`);
  $("dial-target").textContent = `To ${number(degrees, 0)}°`;
  return undefined;
}
const nearest = (degrees) => degrees + 360 * Math.round(((tableDeg ?? 0) - degrees) / 360); // no revolution for nothing

async function rotateTo(degrees) {
  aim(null);
  await submit({ kind: "goto", angle_deg: Number(degrees.toFixed(2)) });
}

$("dial").addEventListener("pointerdown", (event) => {
  const place = (one) => {
    const box = $("dial").getBoundingClientRect();
    return nearest(Math.round((Math.atan2(box.x + box.width / 2 - one.clientX, box.y + box.height / 2 - one.clientY) * 180) / Math.PI));
  };
  $("dial").setPointerCapture(event.pointerId);
  aim(place(event));
  $("dial").onpointermove = (move) => aim(place(move));
  $("dial").onpointerup = () => { $("dial").onpointermove = null; $("dial").onpointerup = null; if (wanted !== null) rotateTo(wanted); };
  $("dial").onpointercancel = () => { $("dial").onpointermove = null; aim(null); };
});
$("dial").addEventListener("keydown", (event) => {
  const step = { ArrowLeft: 5, ArrowUp: 5, ArrowRight: -5, ArrowDown: -5, PageUp: 45, PageDown: -45 }[event.key];
  if (step) aim((wanted ?? Math.round((tableDeg ?? 0) / 5) * 5) + step);
  else if (event.key === "Enter" && wanted !== null) rotateTo(wanted);
  else if (event.key === "Escape" && wanted !== null) aim(null);
  else return;
  event.preventDefault();
});

$("jog").replaceChildren(...[90, 15, 5, 1, -1, -5, -15, -90].map((step) => h("button", { type: "button", class: "quiet", "aria-label": `Rotate by ${number(step)}°`, onclick: () => { if (tableDeg !== null) rotateTo(tableDeg + step); } }, `${step > 0 ? "+" : ""}${number(step)}`)));
$("here").addEventListener("click", () => submit({ kind: "reference", here: true }));

on("status", (status) => {
  if (!status.open) return;
  if (status.limits_deg) dial(status);
  $("states").replaceChildren(...STATES.map((state) => h("li", { class: state === status.state ? `current ${state}` : "", "aria-current": state === status.state }, state)));
  const values = [["Cable", status.limits_deg ? `from ${number(status.limits_deg[0])}° to ${number(status.limits_deg[1])}°` : "–"]];
  if (gyro !== null) values.push(["By the gyro", `${number(gyro, 2)}°`]);
  if (status.servo) values.push(["Servo", `${status.servo.model.replaceAll("_", "-").toUpperCase()}, ${number(status.servo.temperature_c)} °C, ${status.servo.voltage_v.toFixed(1)} V, load ${number(status.servo.load_percent, 0)} %`]);
  if (status.camera) values.push(["Camera", `${status.camera.name}, ${status.camera.width} × ${status.camera.height}`]);
  for (const finding of status.findings || []) values.push(["Note", finding]);
  $("values").replaceChildren(...definitions(values));
  $("set-angle").hidden = !status.doubt;
  $("doubt").textContent = status.doubt ? `The table's angle is in doubt: ${status.doubt}.` : "";
  showLocks(status.locks || {});
});

on("plan", (event) => {
  if (event.event === "moved") gyro = event.rotation_imu_deg === null ? null : event.encoder_deg - event.rotation_encoder_deg + event.rotation_imu_deg;
});

// -- jobs, the check of the bench ------------------------------------------------------------------------------------------

let lastEnded = "";
listJobs((job) => {
  if (job.request.kind === "doctor" && job.result) findings(job.result.findings, job.ended_utc || job.started_utc);
  if (job.ended_utc && job.ended_utc !== lastEnded) {
    lastEnded = job.ended_utc;
    showTour();
  }
});

const MARKS = { fine: "✓", warning: "!", bad: "✗" };
const ORDER = ["bad", "warning", "fine"];

function findings(list, utc) {
  const counts = ORDER.map((level) => list.filter((one) => one.level === level).length);
  $("check-words").textContent = `${counts[0] ? `${counts[0]} to repair, ` : "Nothing to repair, "}${counts[1]} to look at, ${counts[2]} fine (${when(utc)}).`;
  const row = (one) => h("li", { class: one.level }, h("span", { class: "mark", "aria-label": one.level }, MARKS[one.level]), h("div", {}, h("strong", {}, one.topic), ` ${one.finding}`, one.steps.length > 0 && h("p", {}, ...nextSteps(one.steps))));
  const [open, fine] = [list.filter((one) => one.level !== "fine"), list.filter((one) => one.level === "fine")];
  open.sort((a, b) => ORDER.indexOf(a.level) - ORDER.indexOf(b.level));
  $("findings").replaceChildren(...open.map(row), fine.length > 0 && h("li", { style: "display: block" }, h("details", {}, h("summary", {}, `${fine.length} fine`), h("ul", { class: "findings" }, ...fine.map(row)))));
}

// -- the camera: meters of the live image, and its locked settings -----------------------------------------------------------

const SIDE = 240; // pixels of the measured image: fine enough for a meter
const canvas = document.createElement("canvas");
const context = canvas.getContext("2d", { willReadFrequently: true });
let sharpest = 1;

/** Measure the live image: the shares of its levels, and the variance of its Laplacian; mark its sharp edges. */
function measure() {
  const image = $("live-image");
  if (!$("camera").open || !image.naturalWidth) return;
  const [width, height] = [SIDE, Math.round((SIDE * image.naturalHeight) / image.naturalWidth)];
  [canvas.width, canvas.height] = [width, height];
  context.drawImage(image, 0, 0, width, height);
  const { data } = context.getImageData(0, 0, width, height);
  const grey = new Float32Array(width * height);
  const levels = new Array(64).fill(0);
  for (let k = 0; k < grey.length; k += 1) {
    grey[k] = 0.114 * data[4 * k + 2] + 0.587 * data[4 * k + 1] + 0.299 * data[4 * k];
    levels[Math.min(63, grey[k] >> 2)] += 1;
  }
  let [sum, squares, count] = [0, 0, 0];
  const edges = [];
  for (let y = 1; y < height - 1; y += 1) {
    for (let x = 1; x < width - 1; x += 1) {
      const k = y * width + x;
      const value = 4 * grey[k] - grey[k - 1] - grey[k + 1] - grey[k - width] - grey[k + width];
      [sum, squares, count] = [sum + value, squares + value * value, count + 1];
      if (Math.abs(value) > 60) edges.push([x, y]);
    }
  }
  const sharpness = squares / count - (sum / count) ** 2;
  sharpest = Math.max(sharpest * 0.995, sharpness);
  $("sharp").value = sharpness / sharpest;
  $("sharp-words").textContent = `${sharpness.toFixed(0)} of ${sharpest.toFixed(0)}`;
  const scale = image.naturalWidth / width;
  const marks = $("peaking").checked ? edges.map(([x, y]) => h("rect", { x: x * scale, y: y * scale, width: scale, height: scale, fill: "#3df26b" })) : [];
  $("marks").replaceChildren(...marks);
  const most = Math.max(...levels.slice(0, 63), 1);
  const tall = (level) => Math.min(58, 58 * Math.sqrt(level / most));
  const bars = levels.map((level, k) => h("rect", { x: k * 4, y: 60 - tall(level), width: 3.4, height: tall(level), fill: "currentColor", class: k === 63 && level > 20 ? "limit" : "none" }));
  $("histogram").replaceChildren(h("svg", { viewBox: "0 0 256 60", class: "chart", style: "height: 4rem", preserveAspectRatio: "none", role: "img", "aria-label": "Levels of the image, dark at the left" }, ...bars));
}
$("peaking").addEventListener("change", measure);
setInterval(measure, 400);

const LOCKS = [["exposure_us", "Exposure time, µs"], ["gain", "Gain"], ["white_balance_k", "White balance, K"], ["focus", "Focus"]];
let locksShown = "";

/** Show the settings that this camera has. */
function showLocks(locks) {
  if (JSON.stringify(locks) === locksShown) return;
  locksShown = JSON.stringify(locks);
  const there = LOCKS.filter(([key]) => locks[key] !== null && locks[key] !== undefined);
  $("lock-fields").replaceChildren(...there.flatMap(([key, words]) => [h("label", { for: `lock-${key}` }, words), h("input", { id: `lock-${key}`, name: key, type: "number", step: "any", value: Number(locks[key].toPrecision(6)) })]));
  if (!there.length) $("lock-fields").replaceChildren(h("p", { class: "soft" }, "This camera lets no setting be locked."));
}
const lockValues = () => Object.fromEntries([...$("lock-fields").querySelectorAll("input")].filter((field) => field.value !== "").map((field) => [field.name, Number(field.value)]));
$("locks").addEventListener("submit", (event) => {
  event.preventDefault();
  submit({ kind: "camera", ...lockValues() });
});
$("lock-save").addEventListener("click", () => act(async () => {
  const values = lockValues();
  await request("POST", "/jobs", { kind: "camera", ...values });
  for (const [key, value] of Object.entries(values)) await request("PUT", `/settings/camera.${key}`, { value });
  toast("The camera keeps these settings, also after the server starts again.");
}));

// -- the tour ------------------------------------------------------------------------------------------------------------------

let shelf = null;

/** Show the way to the first answer until there is one. What is done is seen from the bench, not remembered. */
async function showTour() {
  if (localStorage.getItem("rig-tour") === "hidden") return;
  const [jobs, objects, results] = await Promise.all([get("/jobs?limit=200"), get("/objects?limit=5"), get("/results?limit=1")]);
  const done = (kind) => jobs.items.some((job) => job.request.kind === kind && job.state === "done");
  const enrolled = objects.items.some((one) => one.views > 0);
  $("tour").hidden = results.total > 0;
  const put = shelf ? (shelf.object ? `${shelf.object} is there.` : "Click one on the shelf below.") : "Put one there, and take your hands away.";
  const steps = [
    [done("empty-table") || enrolled, "Photograph the empty table, so that objects stand out.", h("button", { "data-job": "empty-table" }, "Take the image")],
    [enrolled || Boolean(shelf?.object), `Put an object on the table. ${put}`, null],
    [enrolled, "Enroll it: the table turns once, and takes its views.", h("a", { class: "button", href: "/enroll" }, "Enroll")],
    [objects.total > 1, "Enroll another one that looks similar.", h("a", { class: "button", href: "/enroll" }, "Enroll")],
    [results.total > 0, "Put one of them back in any orientation: which one is it?", h("a", { class: "button", href: "/identify" }, "Identify")],
  ];
  const next = steps.findIndex(([isDone]) => !isDone);
  $("tour-steps").replaceChildren(...steps.map(([isDone, words, button], k) => h("li", { class: isDone ? "done" : k === next ? "now" : "" }, h("span", {}, words), k === next && button)));
}
$("tour-close").addEventListener("click", () => { localStorage.setItem("rig-tour", "hidden"); $("tour").hidden = true; });
document.addEventListener("changed", (event) => { shelf = event.detail; act(showTour); });
on("hello", () => act(showTour));
start();
