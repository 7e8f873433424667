import { $, API, act, ask, at, canOperate, counted, dayOf, definitions, followJob, get, h, isEnded, on, request, showJob, start, submit, toast, when } from "./rig.js";
import { comparisons } from "./pictures.js";

let one = null;
const wanted = () => new URLSearchParams(location.search).get("name") || "";

// -- the views -------------------------------------------------------------------------------------------------------------

let silhouettes = {};

async function showView(view) {
  const e = view.evidence;
  $("view").replaceChildren(...definitions([
    ["View", `${view.index + 1} of ${one.views_taken.length}`],
    ["Taken", view.captured_utc && when(view.captured_utc)],
    ["Sharpness", e.sharpness?.toFixed(0)],
    ["Brightness", e.mean_level === undefined ? null : `${e.mean_level.toFixed(0)} of 255`],
    ["Too bright", e.saturated_share === undefined ? null : `${(100 * e.saturated_share).toFixed(1)} %`],
    ["Exposure", e.locks?.exposure_us && `${(e.locks.exposure_us / 1000).toFixed(1)} ms`],
  ]));
  // of an import, no bench knows where it stood; of views in motion, the table stands at none of their angles
  $("retake").disabled = !canOperate() || !view.captured_utc || Boolean(view.evidence.motion);
  if (!$("outline-on").checked) return;
  const place = one.views_taken.indexOf(view);
  silhouettes[place] ||= get(`/silhouette?object=${at(one.name)}&index=${place}`).catch(() => null);
  const found = await silhouettes[place];
  if (found && $("viewer").views[$("viewer").place] === view) $("viewer").silhouette(found);
}
$("viewer").addEventListener("view", (event) => showView(event.detail));
$("outline-on").addEventListener("change", () => $("viewer").showPlace($("viewer").place));

// -- the object -------------------------------------------------------------------------------------------------------------

const ENROLLMENT = { complete: ["in use", "good"], superseded: ["replaced", ""], abandoned: ["given up", ""], "in progress": ["not complete", "amber"] };

async function load() {
  one = await get(`/objects/${at(wanted())}`);
  $("object-name").textContent = one.name;
  document.title = `${one.name} – ${document.title.split(" – ").at(-1)}`;
  $("object-label").textContent = one.label;
  silhouettes = {};
  $("about").replaceChildren(...definitions([
    ["Views", one.unfinished_views === null ? String(one.views) : `${one.unfinished_views}, interrupted`],
    ["Label", one.label],
    ["Note", one.note],
    ["First enrolled", dayOf(one.created_utc)],
    ["Looks the same", one.similar?.period_deg === 0 ? "from all sides" : one.similar?.period_deg && one.similar.period_deg < 360 ? `every ${one.similar.period_deg}°` : null],
  ]));
  $("again").href = `/enroll?name=${at(one.name)}`;
  $("again").textContent = one.unfinished_views === null ? "Enroll again" : "Continue the enrollment";
  $("object-export").href = `${API}/export?name=${at(one.name)}`;
  for (const id of ["rename", "label", "delete"]) $(id).disabled = !canOperate();
  $("enrollments").replaceChildren(...one.enrollments.map((e) => {
    const [words, kind] = ENROLLMENT[e.status] || [e.status, ""];
    const bench = e.sessions[0] ? `, bench ${e.sessions[0].bench}` : "";
    return h("li", {}, h("span", { class: `tag ${kind}` }, words), ` ${when(e.started_utc)}: ${e.stored_views} of ${counted(e.planned_views, "view")}${bench}`);
  }));
  $("viewer").hidden = !one.views_taken.length;
  if (one.views_taken.length) $("viewer").show(one.name, one.views_taken);
  act(showSimilar);
}

async function showSimilar() {
  const parts = await comparisons(one.name, one.similar?.objects || []);
  $("similar").replaceChildren(...parts);
  $("similar-section").hidden = !parts.length;
}

// -- changes -----------------------------------------------------------------------------------------------------------------

const change = (name, body) => request("PATCH", `/objects/${at(name)}`, body);

$("rename").addEventListener("click", async () => {
  const field = h("input", { value: one.name, "aria-label": "New name", maxlength: 100 });
  if ((await ask(`Rename ${one.name}`, field, [["save", "Rename"]])) !== "save" || field.value === one.name) return;
  await act(async () => {
    const before = one.name;
    const to = (name) => { history.replaceState(null, "", `/object?name=${at(name)}`); return load(); };
    const { name } = await change(before, { name: field.value });
    await to(name);
    toast(`${before} is now ${name}.`, async () => { await change(name, { name: before }); await to(before); });
  });
});
$("label").addEventListener("click", async () => {
  const [label, note] = [h("input", { value: one.label, id: "new-label", maxlength: 1000 }), h("textarea", { id: "new-note", rows: 4, maxlength: 10000 }, one.note)];
  const fields = h("div", { class: "fields" }, h("label", { for: "new-label" }, "Label"), label, h("label", { for: "new-note" }, "Note"), note);
  if ((await ask(`Label and note of ${one.name}`, fields, [["save", "Save"]])) !== "save") return;
  await act(async () => {
    const before = { label: one.label, note: one.note };
    await change(one.name, { label: label.value, note: note.value });
    await load();
    toast("Saved.", async () => { await change(one.name, before); await load(); });
  });
});
$("delete").addEventListener("click", () => act(async () => {
  await request("DELETE", `/objects/${at(one.name)}`);
  $("main").inert = true;
  toast(`${one.name} is deleted. Searches do not find it any more.`, async () => { await request("POST", "/undelete", { name: one.name }); $("main").inert = false; await load(); });
}));


// -- take one view again -------------------------------------------------------------------------------------------------------

$("retake").addEventListener("click", async () => {
  const { index, azimuth_deg: azimuth } = $("viewer").views[$("viewer").place];
  const words = [
    h("p", {}, `${one.name} must stand on the table as it stood when it was enrolled: at the same place, and turned to the same side.`),
    h("p", {}, `The table rotates to ${azimuth.toFixed(0)}°, takes the view, and compares the other side with its stored view. The present view stays in use until the new one has passed.`),
  ];
  if ((await ask(`Take view ${index + 1} again?`, words, [["take", "Take it again"]])) === "take") submit({ kind: "retake", name: one.name, views: [index] });
});

let retaking = null;
followJob(["retake"], {
  render(job) {
    if (job.request.name !== wanted()) return;
    showJob($("job"), job.state === "done" ? null : job);
    if (!isEnded(job)) retaking = job.id;
    else if (job.state === "done" && retaking === job.id) {
      retaking = null;
      toast(job.result_text);
      act(load);
    }
  },
});

on("hello", () => act(load));
start();
