import { $, act, at, counted, duration, followJob, get, h, headline, isEnded, nextSteps, on, showJob, start, submit, table, update, valuesOf } from "./rig.js";
import { comparisons, ringDrawing, thumbs } from "./pictures.js";
import "./shelf.js";

// -- one object: a name that is known already is a choice ------------------------------------------------------------------

let known = null;
let asking = null;
let again = false; // whether an interrupted enrollment is started again instead of continued

/** Say that the name exists, and offer what can be done: continue, replace, another name. */
async function checkName() {
  const name = $("name").value.trim();
  known = name ? await get(`/objects/${at(name)}`).catch(() => null) : null;
  const unfinished = !again && known !== null && known.unfinished_views !== null;
  $("resume").value = String(unfinished);
  $("replace").value = String(known !== null && !unfinished);
  $("exists").hidden = known === null;
  $("go").textContent = unfinished ? "Continue the enrollment" : known ? "Enroll again" : "Enroll";
  if (unfinished) $("exists").replaceChildren(h("p", {}, `Its enrollment was interrupted. ${counted(known.unfinished_views, "view")} of it are stored; the others will be taken. `, h("button", { type: "button", class: "link", onclick: () => { again = true; checkName(); } }, "Start again instead")));
  else if (again) $("exists").replaceChildren(h("p", {}, "The views that are stored will be replaced."));
  else if (known) $("exists").replaceChildren(h("p", {}, `${name} is enrolled with ${counted(known.views, "view")}. Its new views replace them when they are complete.`));
}
$("name").addEventListener("input", () => { again = false; clearTimeout(asking); asking = setTimeout(checkName, 250); });
$("one").addEventListener("submit", async (event) => {
  event.preventDefault();
  clearTimeout(asking);
  await checkName(); // what was known about the name before may have changed
  submit({ kind: "enroll", ...valuesOf($("one")) });
});
const wanted = new URLSearchParams(location.search).get("name");
if (wanted) {
  $("name").value = wanted;
  checkName();
}

// -- the tray: a list that can be edited before the start -----------------------------------------------------------------

const COLUMNS = ["name", "label", "note", "views"];
let objects = [];
let states = {};

/** Return the rows of cells of a CSV text. Quotes are those of RFC 4180. */
export function readCsv(source) {
  const head = source.split("\n", 1)[0];
  const separator = head.split(";").length > head.split(",").length ? ";" : ",";
  const rows = [[]];
  for (const [, quoted, plain, end] of source.matchAll(new RegExp(`(?:"((?:[^"]|"")*)"|([^${separator}\r\n]*))(${separator}|\r?\n|$)`, "g"))) {
    rows.at(-1).push(quoted?.replaceAll('""', '"') ?? plain);
    if (end !== separator) rows.push([]);
  }
  return rows.filter((row) => row.some((cell) => cell.trim()));
}

function stateOf(one) {
  const state = states[one.name];
  if (state) return h("span", { class: `tag ${state === "enrolled" ? "good" : state === "now" ? "amber" : ""}` }, state);
  return h("span", { class: "tag" }, "to do");
}

/** Show the list, with fields while it can be edited. */
function showTray(editable = true) {
  $("tray-section").hidden = objects.length === 0;
  const cell = (one, key) => h("input", { value: one[key] ?? "", "aria-label": `${key} of ${one.name || "a new object"}`, type: key === "views" ? "number" : "text", min: 4, max: 720, required: key === "name", maxlength: 1000,
    oninput: (event) => { one[key] = key === "views" && event.target.value ? Number(event.target.value) : event.target.value; } });
  const rows = objects.map((one, k) => [String(k + 1), ...COLUMNS.map((key) => (editable ? cell(one, key) : one[key])), editable ? h("button", { type: "button", class: "quiet", "aria-label": `Remove ${one.name}`, onclick: () => { objects.splice(k, 1); showTray(); } }, "✕") : stateOf(one)]);
  table($("rows"), ["", "Name", "Label", "Note", "Views", editable ? "" : "State"], rows);
  $("tray-start").hidden = !editable;
  $("tray-clear").hidden = !editable;
}

$("file").addEventListener("change", () => act(async () => {
  const [head, ...rows] = readCsv((await $("file").files[0].text()).replace(/^\ufeff/, ""));
  const keys = (head || []).map((cell) => cell.trim().toLowerCase());
  const unknown = keys.filter((key) => !COLUMNS.includes(key));
  if (!keys.includes("name") || unknown.length) throw Object.assign(new Error("The first line of the file must name the columns: name and, optionally, label, note and views."), { steps: [unknown.length ? `Remove the columns ${unknown.join(", ")}.` : "Add the column \"name\"."] });
  objects = rows.map((row) => {
    const one = {};
    keys.forEach((key, k) => { const cell = (row[k] || "").trim(); if (cell) one[key] = key === "views" ? Number(cell) : cell; });
    return one;
  });
  states = {};
  showTray();
}));
$("add").addEventListener("click", () => {
  objects.push({ name: "" });
  states = {};
  showTray();
  $("rows").querySelector("tbody tr:last-child input").focus();
});
$("tray-clear").addEventListener("click", () => { objects = []; showTray(); });
$("tray").addEventListener("submit", (event) => {
  event.preventDefault();
  const filled = objects.map((one) => Object.fromEntries(Object.entries(one).filter(([, value]) => value !== "")));
  submit({ kind: "tray", objects: filled });
});

// -- the job --------------------------------------------------------------------------------------------------------------

let job = null;
let views = [];
let name = "";
let similar = null;
let rejected = 0;

function take(event) {
  switch (event.event) {
    case "started": [views, similar, rejected, name] = [[], null, 0, event.name || name]; break;
    case "item":
      states[event.name] = event.reason ? "skipped" : "now";
      break;
    case "accepted":
      views.push(event);
      break;
    case "rejected": rejected += 1; break;
    case "similar_objects": similar = event; break;
    case "enrolled": states[event.name] = "enrolled"; break;
    default:
  }
}

/** Show the pictures so far; those that are there already stay. */
function showViews() {
  update($("thumbs"), ...thumbs(job, views));
  $("views-section").hidden = !views.length;
  $("way").hidden = !views.length || isEnded(job);
  $("way").replaceChildren(ringDrawing(views.map((view) => view.azimuth_deg)));
  $("views-title").textContent = `${counted(views.length, "view")}${rejected ? `, ${rejected} taken again` : ""}`;
}

let compared = "";
/** Show what the new object can be confused with: at the side where both look most alike, and where they differ most. */
async function showSimilar() {
  const key = similar ? `${similar.name} ${similar.objects.map((one) => one.name)}` : "";
  if (key === compared) return;
  compared = key;
  $("similar-section").hidden = true;
  if (!similar?.objects.length) return;
  const parts = await comparisons(similar.name, similar.objects);
  if (compared !== key) return;
  $("similar-title").textContent = `${similar.name} looks like ${similar.objects.map((one) => one.name).join(", ")}`;
  $("similar").replaceChildren(...parts);
  $("similar-section").hidden = !parts.length;
}

followJob(["enroll", "tray"], {
  begin(next) {
    job = next;
    [views, similar, rejected, states] = [[], null, 0, {}];
    name = job.request.name || "";
    if (job.request.kind === "tray" && !isEnded(job)) objects = job.request.objects.map((one) => ({ ...one }));
  },
  event: take,
  render(next) {
    job = next;
    const busy = !isEnded(job);
    $("forms").hidden = busy;
    showJob($("job"), job, false);
    const left = job.progress?.seconds_left;
    if (job.question) headline("said", name || "A tray", "calm");
    else if (job.state === "queued") headline("said", "Waiting for the bench …", "calm");
    else if (busy) headline("said", name || "Preparing …", "calm", `${job.state === "paused" ? "Paused. " : "Keep your hands off the table. "}${left ? `About ${duration(left)} left.` : ""}`);
    else if (job.state === "done") headline("said", job.request.kind === "tray" ? "The tray is enrolled" : `${job.request.name} is enrolled`, "found", h("p", {}, similar && !similar.objects.length ? "It looks like no other enrolled object. " : "", job.request.name && h("a", { href: `/object?name=${at(job.request.name)}` }, "Look at it")), h("p", {}, "Put the next object on the table."));
    else headline("said", job.state === "failed" ? "Not enrolled" : "Interrupted", "unknown", job.error && h("p", {}, `${job.error.detail} `, ...nextSteps(job.error.steps)), job.resume && h("p", {}, h("button", { onclick: () => submit(job.resume) }, job.views || job.request.kind === "tray" ? "Continue" : "Try again")));
    showViews();
    if (job.request.kind === "tray" && objects.length && Object.keys(states).length) showTray(false);
    showSimilar();
  },
});
on("hello", () => { if (objects.length === 0) showTray(); });
start();
