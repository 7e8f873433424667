// Calibrations, runs, log and settings: each part runs on the page that has its element.
import { $, API, act, counted, followJobs, h, on, pager, percent, request, start, submit, table, whoami } from "./rig.js";

if ($("calibrations")) {
  const load = async () => {
    const found = await request("GET", "/calibrations");
    $("available").replaceChildren(...Object.entries(found.available).map(([name, title]) => h("button", { onclick: () => submit({ kind: "calibrate", name }) }, title)));
    if (!Object.keys(found.available).length) $("available").replaceChildren(h("p", {}, "No calibrations are installed."));
    table($("calibrations"), ["Calibration", "Date", "Outcome", "Values"], found.history.map((one) => [one.name, one.when_utc, one.passed ? "passed" : "not passed", Object.entries(one.values).map(([key, value]) => `${key} ${value}`).join("; ")]));
  };
  on("hello", () => act(load));
  followJobs(["calibrate"], (job) => { if (job.state === "done") act(load); });
}

if ($("runs")) {
  const open = async (name) => {
    const run = await request("GET", `/runs/${name}`);
    $("checked").textContent = "";
    $("run-actions").replaceChildren(
      h("a", { class: "button", href: `${API}/runs/${name}/report`, target: "_blank" }, "Open the report"),
      h("button", { onclick: () => act(async () => {
        $("checked").textContent = "Computing again …";
        const done = await request("POST", `/runs/${name}/check`);
        $("checked").textContent = done.differences.length ? `${counted(done.differences.length, "difference")}: ${done.differences.slice(0, 3).join("; ")}` : `Computed again: ${counted(done.views, "descriptor")} and ${counted(done.decisions, "decision")}. All are as saved.`;
      }) }, "Compute again"));
    $("replay").replaceChildren(...run.events.filter((event) => event.text).map((event) => h("li", {}, event.text)));
  };
  const answers = async () => {
    const page = await request("GET", "/results?limit=50");
    table($("answers"), ["Time (UTC)", "Sample", "Answer", "Confidence", "Views", "Operator"], page.items.map((one) => [one.time_utc.slice(0, 19).replace("T", " "), one.sample, one.outcome === "unknown" ? "unknown object" : `${one.outcome === "ambiguous" ? "ambiguous: " : ""}${one.object}${one.corrections ? " (corrected)" : ""}`, one.confidence === null ? "" : percent(one.confidence), one.views, one.operator]));
  };
  on("hello", () => act(answers));
  const runs = pager(() => "/runs?limit=50", ({ items }, isFirst) => {
    if (isFirst) $("runs").replaceChildren();
    $("runs").append(...items.map((run) => h("li", {}, h("button", { class: "quiet", onclick: () => act(() => open(run.name)) }, run.name))));
    if (!$("runs").children.length) $("runs").append(h("li", {}, "There are no runs yet. Identify an object."));
  });
  on("hello", () => act(runs));
}

if ($("log")) {
  let rows = [];
  const log = pager(() => "/log?limit=100", ({ items }, isFirst) => {
    rows = isFirst ? items : [...rows, ...items];
    table($("log"), ["Time (UTC)", "Action", "Object", "User", "Details"], rows.map((one) => [one.time_utc, one.action, one.object_name, `${one.user} on ${one.host}`, JSON.stringify(one.details)]));
  });
  on("hello", () => act(log));
}

if ($("configuration")) {
  const flat = (values, prefix = "") => Object.entries(values).flatMap(([key, value]) => (value !== null && typeof value === "object" && !Array.isArray(value) ? flat(value, `${prefix}${key}.`) : [[prefix + key, value === null ? "none" : JSON.stringify(value)]]));
  on("hello", () => act(async () => table($("configuration"), ["Key", "Value"], flat(await request("GET", "/configuration")))));
  on("me", () => { $("you").textContent = `User ${whoami().name}. You may ${whoami().role === "operate" ? "operate the bench" : "only watch"}.`; $("logout").hidden = whoami().name === "local"; });
  $("logout").addEventListener("click", () => act(async () => { await request("POST", "/logout"); location.assign("/login"); }));
}
start();
