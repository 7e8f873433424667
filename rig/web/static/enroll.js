import { $, act, followJobs, h, on, start, submit, table } from "./rig.js";

// -- the tray ------------------------------------------------------------------------------------------------------------

let objects = [];

/** Return the rows of cells of a CSV text. Quotes are those of RFC 4180. */
export function readCsv(source) {
  const head = source.split("\n", 1)[0];
  const separator = head.split(";").length > head.split(",").length ? ";" : ",";
  const rows = [[""]];
  let quoted = false;
  for (let k = 0; k < source.length; k += 1) {
    const c = source[k];
    const row = rows[rows.length - 1];
    if (quoted) {
      if (c !== '"') row[row.length - 1] += c;
      else if (source[k + 1] === '"') row[row.length - 1] += source[(k += 1)];
      else quoted = false;
    } else if (c === '"') quoted = true;
    else if (c === separator) row.push("");
    else if (c === "\n") rows.push([""]);
    else if (c !== "\r") row[row.length - 1] += c;
  }
  return rows.filter((row) => row.some((cell) => cell.trim()));
}

$("file").addEventListener("change", () => act(async () => {
  $("tray-start").disabled = true;
  const [head, ...rows] = readCsv((await $("file").files[0].text()).replace(/^\ufeff/, ""));
  const keys = (head || []).map((cell) => cell.trim().toLowerCase());
  const unknown = keys.filter((key) => !["name", "label", "note", "views"].includes(key));
  if (!keys.includes("name") || unknown.length) throw Object.assign(new Error("The first line of the file must name the columns: name and, optionally, label, note and views."), { steps: [unknown.length ? `Remove the columns ${unknown.join(", ")}.` : "Add the column \"name\"."] });
  objects = rows.map((row) => {
    const one = {};
    keys.forEach((key, k) => { const cell = (row[k] || "").trim(); if (cell) one[key] = key === "views" ? Number(cell) : cell; });
    return one;
  });
  const preview = h("table", {});
  table(preview, ["Name", "Label", "Note", "Views"], objects.map((one) => [one.name, one.label, one.note, one.views]));
  $("rows").replaceChildren(preview);
  $("tray-start").disabled = objects.length === 0;
}));
$("tray").addEventListener("submit", (event) => {
  event.preventDefault();
  submit({ kind: "tray", objects });
});

// -- progress -------------------------------------------------------------------------------------------------------------

function checks(event) {
  const e = event.evidence;
  return `view ${event.index + 1}, ${event.azimuth_deg.toFixed(0)}°: sharpness ${e.sharpness.toFixed(0)}, mean level ${e.mean_level.toFixed(0)}`;
}

on("shown-plan", (event) => {
  if (event.event === "rejected") $("thumbs").append(h("li", { class: "error" }, event.text));
  if (event.event === "similar_objects") $("similar").replaceChildren(...event.text.split("\n").map((words) => h("li", {}, words)));
});
followJobs(["enroll", "tray"], (job, isOther) => { if (isOther) $("similar").replaceChildren(); }, checks);
start();
