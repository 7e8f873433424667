// Pictures: the live image, an object that turns, pairs of pictures, the path of a search.
import { API, at, duration, get, h, on } from "./rig.js";

export const viewPicture = (id) => `${API}/views/${id}/image`;
export const posePicture = (name, azimuthDeg = 0) => `${API}/pose-picture?object=${at(name)}&azimuth_deg=${azimuthDeg.toFixed(1)}`;

/** Return a picture with words below it. */
export function picture(source, alt, ...words) {
  return h("figure", {}, h("div", { class: "frame" }, h("img", { src: source, alt })), words.length > 0 && h("figcaption", {}, ...words));
}

/** Return the pictures of the views that a job has taken so far, as the entries of a list. */
export const thumbs = (job, views) => views.map((view) => h("li", {}, h("img", { src: `${API}/jobs/${job.id}/views/${view.picture}`, alt: "", loading: "lazy" }), `${view.azimuth_deg.toFixed(0)}°`));

/** Return for each of some objects where an object and it look most alike, and where they differ most. */
export async function comparisons(name, others) {
  const side = (view, azimuth, of, words) => picture(viewPicture(view), `${of} at ${azimuth.toFixed(0)}°`, words);
  const pair = (found, other, words) => h("div", {}, h("h3", {}, words), h("div", { class: "pair" }, side(found.view, found.azimuth_deg, name, name), side(found.other_view, found.other_azimuth_deg, other, h("a", { href: `/object?name=${at(other)}` }, other))));
  const found = await Promise.all(others.map((other) => get(`/pairs?object=${at(name)}&other=${at(other.name)}`).catch(() => null)));
  return others.flatMap(({ name: other }, k) => (found[k] ? [h("div", { class: "columns" }, pair(found[k].alike, other, `${other}: most alike`), pair(found[k].different, other, "Most different"))] : []));
}

// -- the live image: one short request after the other. An endless one would occupy one of the browser's few connections ---

const PICTURE_MS = 200;
const STALE_S = 3;

/** The live image, cut to the region that is described; with its age, and a mark when no new one comes. */
class RigLive extends HTMLElement {
  takenAt = null;

  connectedCallback() {
    this.image = h("img", { id: "live-image", class: "whole", alt: "Live image of the table" });
    this.marks = h("svg", { id: "marks", "aria-hidden": "true" }); // in pixels of the image
    this.age = h("p", { id: "live-age", role: "status", hidden: true });
    this.frame = h("div", { class: "picture", id: "live" }, this.image, this.marks, this.age);
    this.append(this.frame);
    this.image.addEventListener("load", () => this.fit());
    on("status", (status) => { if (status.open) { this.region = status.region; this.fit(); } });
    on("plan", ({ event, segmentation }) => {
      if (["started", "moved", "waiting"].includes(event)) this.marks.replaceChildren();
      if (segmentation?.box_px) this.showBox(segmentation.box_px);
    });
    this.fetchAll();
    setInterval(() => this.mark(), 500);
  }

  /** Show the region of interest only, unless the whole frame is wanted. */
  fit() {
    const { naturalWidth: width, naturalHeight: height } = this.image;
    if (!width) return;
    const [x, y, w, tall] = (!this.hasAttribute("whole") && this.region) || [0, 0, width, height];
    const style = this.image.style;
    this.frame.style.aspectRatio = `${w} / ${tall}`;
    [style.width, style.height] = [`${(100 * width) / w}%`, `${(100 * height) / tall}%`];
    [style.left, style.top] = [`${(-100 * x) / w}%`, `${(-100 * y) / tall}%`];
    style.maxWidth = "none";
    this.marks.setAttribute("viewBox", `${x} ${y} ${w} ${tall}`);
  }

  /** Show where the program found the object, by its box in the region. */
  showBox([x, y, width, height]) {
    const [left, top] = this.region || [0, 0];
    this.marks.replaceChildren(h("rect", { x: left + x, y: top + y, width, height, fill: "none", stroke: "#ffd34d", "stroke-width": 2, "vector-effect": "non-scaling-stroke" }));
  }

  async fetchOne() {
    const answer = await fetch(`${API}/picture`, { cache: "no-store" });
    if (!answer.ok) return;
    this.takenAt = performance.now() - 1000 * Number(answer.headers.get("X-Rig-Picture-Age"));
    const before = this.image.src;
    this.image.src = URL.createObjectURL(await answer.blob());
    if (before.startsWith("blob:")) URL.revokeObjectURL(before);
  }

  async fetchAll() {
    if (!document.hidden) await this.fetchOne().catch(() => {}); // the line of the state says that the server does not answer
    setTimeout(() => this.fetchAll(), document.hidden ? 1000 : PICTURE_MS);
  }

  /** Mark an old picture: the camera may be unplugged, or the bench may not answer. */
  mark() {
    const age = this.takenAt === null ? null : (performance.now() - this.takenAt) / 1000;
    const stale = age === null || age > STALE_S;
    this.frame.classList.toggle("stale", stale);
    this.age.hidden = !stale;
    this.age.textContent = age === null ? "No image from the camera yet." : `This image is ${duration(age)} old: no new one comes.`;
  }
}
customElements.define("rig-live", RigLive);

// -- an object that turns ------------------------------------------------------------------------------------------------

/** The enrolled views of an object: drag, use the slider or the arrow keys to turn it. It tells which view is shown. */
class RigViewer extends HTMLElement {
  show(name, views) {
    this.views = [...views].sort((a, b) => a.azimuth_deg - b.azimuth_deg);
    this.image = h("img", { alt: `${name}, turned`, draggable: "false" });
    this.overlay = h("svg", { "aria-hidden": "true" });
    this.words = h("p", { class: "number" });
    this.slider = h("input", { type: "range", min: 0, max: this.views.length - 1, step: 1, "aria-label": "Side of the object", oninput: () => this.showPlace(Number(this.slider.value)) });
    const frame = h("div", { class: "picture", style: "cursor: grab; touch-action: pan-y" }, this.image, this.overlay);
    this.replaceChildren(frame, this.slider, this.words);
    frame.addEventListener("pointerdown", (event) => {
      const [from, first] = [event.clientX, this.place];
      frame.setPointerCapture(event.pointerId);
      frame.onpointermove = (move) => this.showPlace(first + Math.round(((move.clientX - from) / frame.clientWidth) * this.views.length));
      frame.onpointerup = () => { frame.onpointermove = null; };
      frame.onpointercancel = frame.onpointerup;
    });
    for (const view of this.views) new Image().src = viewPicture(view.id); // so that it turns without waiting
    this.showPlace(this.name === name ? this.place : 0);
    this.name = name;
  }

  showPlace(place) {
    const count = this.views.length;
    this.place = ((place % count) + count) % count;
    const view = this.views[this.place];
    this.image.src = viewPicture(view.id);
    this.slider.value = this.place;
    this.slider.setAttribute("aria-valuetext", `${view.azimuth_deg.toFixed(0)}°`);
    this.words.textContent = `${view.azimuth_deg.toFixed(0)}°`;
    this.overlay.replaceChildren();
    this.dispatchEvent(new CustomEvent("view", { detail: view }));
  }

  /** Draw a silhouette over the picture: its points, and the size of the picture that they belong to. */
  silhouette({ points, width, height }) {
    this.overlay.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.overlay.replaceChildren(...points.map((part) => h("polygon", { points: part.map((point) => point.join(",")).join(" "), fill: "none", stroke: "#ffd34d", "stroke-width": 2, "vector-effect": "non-scaling-stroke" })));
  }
}
customElements.define("rig-viewer", RigViewer);

// -- the path of a search ----------------------------------------------------------------------------------------------------

const point = (radius, degrees) => {
  const angle = (degrees * Math.PI) / 180;
  return [100 - radius * Math.sin(angle), 100 - radius * Math.cos(angle)];
};

const table = () => [h("circle", { cx: 100, cy: 100, r: 82, class: "rim" }), h("circle", { cx: 100, cy: 100, r: 16, class: "seen", opacity: 0.25 })];
const drawing = (label, ...parts) => h("svg", { viewBox: "0 0 200 200", class: "chart", role: "img", "aria-label": label }, ...parts);

/** Return a small drawing of the table with a dot for each view that is stored. */
export function ringDrawing(azimuths) {
  const dots = azimuths.map((azimuth) => point(82, azimuth)).map(([cx, cy]) => h("circle", { cx, cy, r: 5, class: "dot c0" }));
  return drawing(`${azimuths.length} views around the object`, ...table(), ...dots);
}

/** Return a small drawing of the camera's way around the object, seen from above: 0° at the top, counter-clockwise. */
export function pathDrawing(azimuths) {
  const parts = table();
  const step = Math.min(12, 40 / Math.max(azimuths.length, 1));
  azimuths.forEach((azimuth, k) => {
    if (k) {
      const before = azimuths[k - 1];
      const rotation = ((azimuth - before + 540) % 360) - 180;
      const arc = Array.from({ length: 25 }, (_, n) => point(38 + step * (k - 1 + n / 24), before + (rotation * n) / 24));
      parts.push(h("path", { class: "step", d: arc.map(([x, y], n) => `${n ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`).join("") }));
    }
  });
  azimuths.forEach((azimuth, k) => {
    const [x, y] = point(38 + step * k, azimuth);
    parts.push(h("circle", { cx: x, cy: y, r: 11, class: "stop" }), h("text", { x, y: y + 5, "text-anchor": "middle", class: "stop-number" }, String(k + 1)));
  });
  const label = azimuths.length ? `The camera's way around the object: ${azimuths.map((one) => `${one.toFixed(0)}°`).join(", ")}` : "No view yet";
  return drawing(label, ...parts);
}
