import { $, API, act, answerWords, at, counted, either, followJob, get, h, headline, isEnded, nextSteps, on, percent, showJob, start, update, when } from "./rig.js";
import { pathDrawing, picture, posePicture, thumbs, viewPicture } from "./pictures.js";
import "./shelf.js";

const SHOWN = 4; // candidates: more are unlikely, and push the steps out of sight
const KEPT = 10;
const EMPTY_TABLE = 606;

// -- the form -----------------------------------------------------------------------------------------------------------

function chooseMode() {
  const many = $("watch").checked;
  $("sample").disabled = many;
  $("sample").hidden = many;
  $("sample-label").hidden = many;
  $("scan-label").hidden = !many;
  $("scan").disabled = !many;
}
for (const radio of $("start").elements.watch) radio.addEventListener("change", chooseMode);
chooseMode(); // a browser that reloads the page can keep the choice

$("sound").checked = localStorage.getItem("rig-sound") === "1";
$("sound").addEventListener("change", () => localStorage.setItem("rig-sound", $("sound").checked ? "1" : ""));

/** Play a short tone: a rising one for a found object, a falling one for anything else. */
function play(found) {
  if (!$("sound").checked) return;
  navigator.vibrate?.(found ? 80 : [80, 80, 80]);
  const audio = new AudioContext();
  [found ? 660 : 440, found ? 880 : 330].forEach((hertz, k) => {
    const [tone, volume] = [audio.createOscillator(), audio.createGain()];
    tone.frequency.value = hertz;
    volume.gain.value = 0.15;
    tone.connect(volume).connect(audio.destination);
    tone.start(audio.currentTime + 0.16 * k);
    tone.stop(audio.currentTime + 0.16 * k + 0.14);
  });
}

// -- the search, as its events tell it ------------------------------------------------------------------------------------

const COLOURS = 8;
const colours = new Map(); // of the candidates of a job: an object keeps its own after each view
let search = null; // of the object on the table: views, steps, candidates
let shown = null; // the answer that is large
let ready = false; // whether events are new, not those of a page that was opened later

function newSearch() {
  search = { views: [], steps: [], notes: [], candidates: [], notEnrolled: null, live: "" };
}
newSearch();

const REASONS = {
  "separates-candidates": (event) => ` to see where ${either(event.candidates.slice(0, 2))} differ`,
  "less-similar-side": () => " to the side where the candidates look less alike",
  "several-poses": () => " because it fits in several positions",
  "new-side": () => " to see another side",
  "one-candidate": () => " to see another side",
  "least-risk": () => " to see the side that tells most",
};
const AGAIN = { blurred: "it was blurred", "too-dark": "it was too dark", overexposed: "it was too bright", "table-moved": "the table still moved", noise: "it was noisy" };

/** Return a step of the search in plain words; empty for what only the notes tell. */
function plainStep(event) {
  switch (event.event) {
    case "decided": return `Turned ${Math.abs(event.rotation_deg).toFixed(0)}° to the ${event.side}${(REASONS[event.reason] || (() => ""))(event).replace(" or ", " and ")}.`;
    case "ranked": {
      const likely = event.candidates.filter((one) => one.probability === null || one.probability > 0.05).slice(0, 3).map((one) => one.name);
      const unknown = event.decision?.not_enrolled > 0.5;
      return `View ${event.index + 1}: ${unknown ? "looks like no enrolled object" : `looks like ${either(likely.length ? likely : [event.candidates[0].name])}`}.`;
    }
    case "rejected": return `Took view ${event.index + 1} again: ${event.reasons.map((one) => AGAIN[one]).filter(Boolean).join(", ") || "it was not good enough"}.`;
    case "unwinding": return "Turned back to free the cable.";
    case "object_changed": return "The object was changed or turned by hand. The search began again.";
    case "scan_started": return "Turned without a stop.";
    default: return "";
  }
}

function take(event, job) {
  const s = search;
  switch (event.event) {
    case "started": newSearch(); shown = job.request.watch ? shown : null; break;
    case "waiting": search.live = event.reason === "first-object" ? "Put an object on the table." : "Put the next object on the table."; break;
    case "frame_used": s.live = `Looks like ${event.name} …`; break;
    case "accepted": s.views.push(event); break;
    case "ranked":
      [s.candidates, s.notEnrolled] = [event.candidates, event.decision?.not_enrolled ?? null];
      for (const { name } of event.candidates) if (!colours.has(name)) colours.set(name, `c${colours.size % COLOURS}`);
      break;
    case "identified": keep({ ...event, search: s }, job); break;
    case "failed": keep({ event: "failed", outcome: "failed", error: event, search: s }, job); break;
    case "recorded": if (ready) act(showLast); break;
    default:
  }
  const words = plainStep(event);
  if (words && event.event === "ranked") s.steps.push({ words });
  else if (words) s.steps.push({ words, soft: true });
  if (event.text && event.event !== "identified") s.notes.push(...event.text.split("\n").map((text) => text.trim()));
  if (event.steps?.length && event.event !== "failed") s.notes.push(...event.steps.filter((step) => typeof step === "string"));
}

function keep(answer, job) {
  shown = { ...answer, job: job.id, watch: job.request.watch, time: ready ? new Date().toISOString() : job.ended_utc || job.started_utc };
  if (ready) play(shown.outcome === "found");
}

// -- what is shown --------------------------------------------------------------------------------------------------------

let twinOf = "";

const enrolledPicture = (one, words) => picture(posePicture(one.name, one.pose_deg), `${one.name} as enrolled, from the same side`, h("strong", {}, one.name), words);

/**
 * Show where two objects differ most. Without a second one it is the enrolled object that looks most like the first,
 * if one does: a fact of the catalog, not of the views that this search happened to take.
 */
async function compare(one = "", other = "") {
  const key = `${one}/${other}`;
  if (twinOf === key) return;
  twinOf = key;
  $("twin").hidden = true;
  if (!one) return;
  const twin = other || (await get(`/objects/${at(one)}`).catch(() => null))?.similar?.objects[0]?.name;
  const found = twin && (await get(`/pairs?object=${at(one)}&other=${at(twin)}`).catch(() => null));
  if (!found || twinOf !== key) return;
  $("twin-title").textContent = `${one} and ${twin} differ most here`;
  const { different: pair } = found;
  $("twin-pictures").replaceChildren(picture(viewPicture(pair.view), `${one} at ${pair.azimuth_deg.toFixed(0)}°`, h("strong", {}, one), `at ${pair.azimuth_deg.toFixed(0)}°`), picture(viewPicture(pair.other_view), `${twin} at ${pair.other_azimuth_deg.toFixed(0)}°`, h("strong", {}, twin), `at ${pair.other_azimuth_deg.toFixed(0)}°`));
  $("twin").hidden = false;
}

function showAnswer(answer) {
  const { candidates = [], outcome } = answer;
  const used = counted(answer.views ?? answer.search?.views.length ?? 0, "view");
  const time = `${when(answer.time)}, ${used}`;
  let pictures = [];
  let after = [];
  if (outcome === "failed") {
    const { error } = answer;
    headline("answer", error.code === EMPTY_TABLE ? "No object on the table" : "No answer", "unknown", error.code === EMPTY_TABLE ? "The table is empty. " : `${error.detail} `, ...nextSteps(error.steps));
  } else if (outcome === "found") {
    const sure = answer.confidence === null || answer.confidence === undefined ? "" : `${percent(answer.confidence)} sure`;
    const rotated = answer.yaw_deg === null || answer.yaw_deg === undefined ? "" : `, turned by ${answer.yaw_deg.toFixed(0)}°`;
    headline("answer", answer.name, "found", [sure, time].filter(Boolean).join(", ") + rotated);
    pictures = [[candidates[0], `as enrolled, from the same side`]];
  } else if (outcome === "ambiguous") {
    headline("answer", either(answer.possible.slice(0, 3)), "ambiguous", `The views do not tell them apart (${time}).`);
    pictures = answer.possible.slice(0, 2).map((name) => [candidates.find((one) => one.name === name) || { name, pose_deg: 0 }, "as enrolled, from the same side"]);
  } else {
    headline("answer", outcome === "unknown" ? "Unknown object" : "No object on the table", "unknown", outcome === "unknown" ? `It is none of the enrolled objects (${time}).` : `The table is empty (${time}).`);
    if (outcome === "unknown") {
      pictures = candidates.slice(0, 1).map((one) => [one, "looks most like it, but is another object"]);
      after = [h("a", { class: "button", href: "/enroll" }, "Enroll it")];
    }
  }
  update($("enrolled"), ...pictures.map(([one, words]) => enrolledPicture(one, words)));
  $("enrolled").hidden = !pictures.length;
  update($("after"), ...after);
  const [one, other] = outcome === "ambiguous" ? answer.possible : [outcome === "found" ? answer.name : ""];
  compare(one, other);
}

function showSearch() {
  const s = search;
  const candidates = s.candidates.slice(0, SHOWN);
  const best = Math.max(...candidates.map((one) => one.probability ?? one.score), s.notEnrolled ?? 0, 1e-9);
  const rows = candidates.map((one) => h("li", { title: one.probability === null ? `score ${one.score.toFixed(3)}` : percent(one.probability) },
    h("img", { src: posePicture(one.name, Math.round(one.pose_deg / 15) * 15), alt: "" }),
    h("div", {}, one.name, h("div", { class: `bar ${colours.get(one.name)}` }, h("i", { style: `width: ${(100 * (one.probability ?? one.score)) / best}%` })))));
  if (s.notEnrolled !== null) rows[s.notEnrolled === best ? "unshift" : "push"](h("li", { title: percent(s.notEnrolled) }, h("span", { class: "none", "aria-hidden": "true" }, "?"), h("div", { class: "soft" }, "none of the enrolled objects", h("div", { class: "bar" }, h("i", { style: `width: ${(100 * s.notEnrolled) / best}%` })))));
  $("candidates").replaceChildren(...rows);
  $("way").replaceChildren(pathDrawing(s.views.slice(-9).map((view) => view.azimuth_deg)));
  $("steps").replaceChildren(...s.steps.slice(-12).map((step) => h("li", { class: step.soft ? "soft" : "" }, step.words)));
  update($("thumbs"), ...thumbs(job, s.views));
  $("notes").replaceChildren(...s.notes.map((words) => h("li", {}, words)));
  $("search").hidden = !s.views.length;
}

/** Show the last recorded answers; each leads to its place in the history. */
async function showLast() {
  const { items } = await get(`/results?limit=${KEPT}`);
  $("last-section").hidden = !items.length;
  $("last").replaceChildren(...items.map((one) => h("li", {}, h("a", { href: `/runs?result=${one.id}` },
    one.image && h("img", { src: `${API}/results/${one.id}/image`, alt: "" }), answerWords(one), one.sample && h("span", { class: "soft" }, ` ${one.sample}`), h("br"), h("span", { class: "soft" }, when(one.time_utc))))));
}

let job = null;
function redraw() {
  if (!job) return;
  const idle = isEnded(job);
  $("go").disabled = !idle && !job.request.watch;
  showJob($("job"), job, false);
  if (shown) showAnswer(shown);
  else if (isEnded(job)) headline("answer", "Stopped", "calm", "No answer. Nothing was recorded.");
  else {
    $("enrolled").hidden = true;
    $("after").replaceChildren();
    compare();
    if (job.state === "queued") headline("answer", "Waiting for the bench …", "calm");
    else if (!idle) headline("answer", search.live && !search.views.length ? search.live : "Searching …", "calm", search.steps.at(-1)?.words || "");
  }
  if (shown && job.request.watch && !idle) $("answer-detail").append(h("p", {}, h("strong", {}, search !== shown.search && search.views.length ? "Searching the next object …" : search.live)));
  showSearch();
}

followJob(["identify"], {
  begin(next) {
    job = next;
    ready = false;
    [shown, twinOf] = [null, ""];
    colours.clear();
    newSearch();
  },
  event: take,
  render(next, loaded) {
    job = next;
    if (!loaded) return;
    ready = true;
    if (isEnded(job) && !shown) {
      if (job.result?.event === "identified") keep({ ...job.result, search }, job);
      else if (job.state === "failed") keep({ outcome: "failed", error: job.error, search }, job);
    }
    redraw();
  },
});
on("hello", () => act(showLast));
start();
