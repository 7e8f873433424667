import { $, API, duration, h, listJobs, nextSteps, number, on, start, submit } from "./rig.js";

const STATES = ["disconnected", "connected", "unreferenced", "ready", "moving", "stopped", "fault"];
let gyro = null;

/** Turn the needles of the dial: 0° is at the top, angles grow counter-clockwise, as the table's do seen from above. */
function dial(status) {
  const angle = status.table_deg;
  const [low, high] = status.limits_deg || [-360, 360];
  const known = angle !== null && angle !== undefined;
  const rotate = (id, degrees) => {
    $(id).toggleAttribute("hidden", degrees === null);
    if (degrees !== null) $(id).setAttribute("transform", `rotate(${-degrees} 200 200)`);
  };
  rotate("needle", known ? angle : null);
  rotate("gyro", known ? gyro : null);
  const used = known ? Math.min(Math.abs(angle) / Math.max(Math.abs(angle < 0 ? low : high), 1), 1) : 0;
  $("used").setAttribute("stroke-dasharray", `${used} 1`);
  $("used").setAttribute("transform", `translate(200 200) rotate(-90) scale(1 ${angle < 0 ? 1 : -1}) translate(-200 -200)`);
  $("used").classList.toggle("much", used > 0.9);
  const moving = status.servo && status.servo.moving ? ` at ${number(status.velocity_dps, 0)} °/s` : "";
  $("dial-text").textContent = known ? `${number(angle, 2)}°${moving}` : "angle in doubt";
}

on("status", (status) => {
  if (!status.open) return;
  if (status.limits_deg) dial(status);
  $("states").replaceChildren(...STATES.map((state) => h("li", { class: state === status.state ? `current ${state}` : "", "aria-current": state === status.state }, state)));
  const values = [["Cable budget", status.limits_deg ? `${number(status.limits_deg[0])}° to ${number(status.limits_deg[1])}°` : "–"]];
  if (gyro !== null) values.push(["Angle by the gyro", `${number(gyro, 2)}°`]);
  if (status.servo) values.push(["Servo", `${status.servo.model.replaceAll("_", "-").toUpperCase()}, ${number(status.servo.temperature_c)} °C, ${status.servo.voltage_v.toFixed(1)} V, load ${number(status.servo.load_percent, 0)} %`]);
  if (status.camera) values.push(["Camera", `${status.camera.name}, ${status.camera.width} × ${status.camera.height}`]);
  for (const finding of status.findings || []) values.push(["Note", finding]);
  $("values").replaceChildren(...values.flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));
  $("set-angle").hidden = !status.doubt;
  $("doubt").textContent = status.doubt ? `The table's angle is in doubt: ${status.doubt}.` : "";
});

on("plan", (event) => {
  if (event.event === "moved") gyro = event.rotation_imu_deg === null ? null : event.encoder_deg - event.rotation_encoder_deg + event.rotation_imu_deg;
  if (event.event === "accepted" && event.outline_px) outline(event.outline_px);
  if (event.event === "moved") $("outline").replaceChildren();
});

/** Draw the outline and the box of the object over the live image. */
function outline(found) {
  const image = $("live-image");
  if (!image.naturalWidth) return;
  $("outline").setAttribute("viewBox", `0 0 ${image.naturalWidth} ${image.naturalHeight}`);
  const [x, y, width, height] = found.box;
  const path = found.points.map(([px, py], k) => `${k ? "L" : "M"}${px} ${py}`).join(" ");
  const style = { fill: "none", "stroke-width": 2 };
  $("outline").replaceChildren(
    h("rect", { x, y, width, height, stroke: "#8ab8ff", "stroke-dasharray": "6 4", ...style }),
    h("path", { d: `${path} Z`, stroke: "#ffd34d", ...style }),
  );
}

listJobs((job) => {
  if (job.request.kind === "doctor" && job.result) findings(job.result.findings);
});

function findings(list) {
  const marks = { fine: "✓", warning: "!", bad: "✗" };
  $("findings-section").hidden = false;
  $("findings").replaceChildren(
    ...list.map((one) => h("li", { class: one.level === "bad" ? "error" : "" }, `${marks[one.level]} ${one.topic}: ${one.finding}`, one.steps.length ? h("p", { class: "soft" }, "Fix: ", ...nextSteps(one.steps)) : null)),
  );
}

$("here").addEventListener("click", () => submit({ kind: "reference", here: true }));

// The live image: one short request after the other. An endless one would occupy one of the browser's few connections.

const PICTURE_MS = 200;
const STALE_S = 3;
let takenAt = null;

async function fetchPicture() {
  const answer = await fetch(`${API}/picture`, { cache: "no-store" });
  if (!answer.ok) return;
  takenAt = performance.now() - 1000 * Number(answer.headers.get("X-Rig-Picture-Age"));
  const before = $("live-image").src;
  $("live-image").src = URL.createObjectURL(await answer.blob());
  if (before.startsWith("blob:")) URL.revokeObjectURL(before);
}
async function fetchPictures() {
  if (!document.hidden) await fetchPicture().catch(() => {}); // the line of the state says that the server does not answer
  setTimeout(fetchPictures, document.hidden ? 1000 : PICTURE_MS);
}
fetchPictures();

/** Mark an old picture: the camera may be unplugged, or the bench may not answer. */
setInterval(() => {
  const age = takenAt === null ? null : (performance.now() - takenAt) / 1000;
  const stale = age === null || age > STALE_S;
  $("live").classList.toggle("stale", stale);
  $("live-age").hidden = !stale;
  $("live-age").textContent = age === null ? "No image from the camera yet." : `This image is ${duration(age)} old: no new one comes.`;
}, 500);
start();
