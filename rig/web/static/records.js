// Calibrations, log, settings and tokens: each part runs on the page that has its element.
import { $, act, ask, at, canOperate, counted, dayOf, definitions, followJob, get, h, number, on, pager, personOf, request, showJob, start, submit, table, timeOf, toast, valuesOf, when, whoami } from "./rig.js";

// -- calibrations -----------------------------------------------------------------------------------------------------------

/** Return how well a calibration fits, beside its limit. */
function residual(one) {
  if (one.residual === null || one.limit === null) return null;
  const share = Math.min(one.residual / one.limit, 1);
  return h("div", {}, h("progress", { max: 1, value: share, "aria-label": "residual, as a share of its limit" }), h("span", { class: "small soft" }, `residual ${Number(one.residual.toPrecision(2))} of at most ${Number(one.limit.toPrecision(2))} ${one.residual_unit}`));
}

/** Return when a result ends, in words. */
function validity(one) {
  if (!one.passed || !one.valid_until) return "";
  const left = (Date.parse(one.valid_until) - Date.now()) / 86400000;
  return left < 0 ? "expired" : `valid for ${counted(Math.ceil(left), "more day")}`;
}

/** Return what a result was compared with, by whom, and the uncertainty budget of each of its quantities. */
function traceability(one) {
  const facts = [["reference", one.reference], ["operator", one.operator], ["software", one.software], ["valid until", one.valid_until ? dayOf(one.valid_until) : "a device changes"]];
  const short = (value, unit = "") => `${Number(value.toPrecision(2))} ${unit}`.trim();
  const rows = Object.entries(one.quantities).flatMap(([name, of]) => of.budget.map((source, i) => {
    const contribution = Math.abs(source.sensitivity) * source.uncertainty;
    return [
      i ? "" : `${name.replaceAll("_", " ")}: ${of.text}; U = ${of.expanded}`,
      source.source, source.kind, short(source.uncertainty, source.unit), short(source.sensitivity), short(contribution), `${of.uncertainty ? Math.round(100 * (contribution / of.uncertainty) ** 2) : 0} %`,
    ];
  }));
  const budget = h("table", { class: "small" });
  table(budget, ["Quantity; U with k = 2", "Source of uncertainty", "Type", "u of the source", "Sensitivity", "Contribution", "Share"], rows);
  return h("details", {}, h("summary", {}, "Uncertainty and reference"),
    h("dl", { class: "values small" }, ...definitions(facts)),
    h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": `Uncertainty budget of ${one.name}` }, budget));
}

if ($("calibrations")) {
  const load = async () => {
    const { history, available } = await get("/calibrations");
    const cards = Object.entries(available).map(([name, title]) => {
      const newest = [...new Map(history.filter((one) => one.name.split(".")[0] === name.replaceAll("-", "_")).reverse().map((one) => [one.name, one])).values()];
      const results = newest.map((one) => h("div", {},
        h("p", {}, h("span", { class: `tag ${one.passed ? "good" : "bad"}` }, one.passed ? "passed" : "not passed"), ` ${when(one.when_utc)}`, validity(one) && h("span", { class: "soft small" }, `, ${validity(one)}`)),
        residual(one),
        h("dl", { class: "values small" }, ...definitions(Object.entries(one.quantities).slice(0, 4).map(([key, of]) => [key.replaceAll("_", " "), of.text]))),
        Object.keys(one.quantities).length ? traceability(one) : null,
        ...one.rejections.map((words) => h("p", { class: "error small" }, words))));
      return h("li", { class: "card" }, h("h2", {}, title), ...(results.length ? results : [h("p", { class: "soft" }, "Never done on this bench.")]), h("button", { class: results.length ? "quiet" : "", onclick: () => submit({ kind: "calibrate", name }) }, results.length ? "Run again" : "Run"));
    });
    $("calibrations").replaceChildren(...(cards.length ? cards : [h("li", { class: "empty" }, "No calibrations are installed.")]));
    table($("history"), ["Calibration", "Date", "Outcome", "Values"], history.map((one) => [one.name, when(one.when_utc), one.passed ? "passed" : "not passed", Object.entries(one.quantities).map(([key, of]) => `${key} ${of.text}`).join("; ")]));
  };
  on("hello", () => act(load));
  followJob(["calibrate"], { render(job) { showJob($("job"), job); if (job.state === "done") act(load); } });
}

// -- the log ------------------------------------------------------------------------------------------------------------------

const OUTCOMES = { found: (name) => `identified ${name}`, unknown: () => "identified an unknown object", ambiguous: (name) => `could not tell ${name} from another object` };
const SENTENCES = {
  "enrollment started": (name, { replace, views }) => `began to enroll ${name}${replace ? " again" : ""}, ${counted(views, "view")}`,
  "enrollment resumed": (name) => `continued the enrollment of ${name}`,
  "enrollment abandoned": (name) => `ended an enrollment of ${name}`,
  "enrollment discarded": (name) => `discarded an enrollment of ${name}`,
  "enrollment superseded": (name) => `replaced the earlier enrollment of ${name}`,
  enrolled: (name, { taken_again: again, views }) => (again ? `took ${counted(again.length, "view")} of ${name} again` : `enrolled ${name} with ${counted(views, "view")}`),
  identified: (name, { outcome, sample }) => (OUTCOMES[outcome]?.(name) || "identified an object") + (sample ? `, sample ${sample}` : ""),
  "result corrected": (name, { result, reason }) => `corrected answer ${result} to ${name || "an unknown object"}: ${reason}`,
  renamed: (name, { before }) => `renamed ${before} to ${name}`,
  labelled: (name) => `changed the label or note of ${name}`,
  deleted: (name) => `deleted ${name}`,
  undeleted: (name) => `restored ${name}`,
  imported: (name) => `imported ${name || "objects"}`,
  "collected garbage": () => "removed deleted objects from the disk",
  delivered: () => "delivered objects to the shared catalog",
  moved: (_name, { to_deg: to, ended }) => `rotated the table to ${number(to, 1)}°${ended ? `, which ended early: ${ended}` : ""}`,
  "photographed the empty table": () => "took the empty-table image",
};

if ($("log")) {
  let lastDay = "";
  const log = pager(() => "/log?limit=100", ({ items }, isFirst) => {
    if (isFirst) [lastDay] = ["", $("log").replaceChildren()];
    for (const entry of items) {
      const day = dayOf(entry.time_utc);
      if (day !== lastDay) $("log").append(h("li", { style: "display: block" }, h("h2", {}, day)));
      lastDay = day;
      const words = SENTENCES[entry.action](entry.object_name, entry.details);
      $("log").append(h("li", {}, h("time", { datetime: entry.time_utc }, timeOf(entry.time_utc)), h("div", {}, h("strong", {}, personOf(entry.details.operator || "") || entry.user), ` ${words.replace(/\.$/, "")}.`)));
    }
    if (!$("log").children.length) $("log").append(h("li", { class: "empty" }, "Nothing has happened yet."));
  });
  on("hello", () => act(log));
}

// -- tokens -------------------------------------------------------------------------------------------------------------------

const ROLES = { watch: "only watch, and press STOP", propose: "watch, and propose jobs", operate: "operate the bench" };

async function loadTokens() {
  const { items } = await get("/tokens");
  const revoke = async ({ name }) => {
    const words = name === whoami().name ? "You are logged in with it, and will be logged out." : "Who uses it is logged out at once, and cannot log in again.";
    if ((await ask(`Revoke the token ${name}?`, h("p", {}, words), [["revoke", "Revoke", "danger"]])) !== "revoke") return;
    await act(async () => { await request("DELETE", `/tokens/${at(name)}`); await loadTokens(); });
  };
  table($("tokens"), ["Name", "May", "Made", "Valid until", "Last used", ""], items.map((one) => [
    one.name,
    ROLES[one.role],
    dayOf(one.created_utc),
    one.expires_utc ? when(one.expires_utc) : "always",
    one.used_utc ? when(one.used_utc) : "not since the server started",
    whoami().name === "local" ? "" : h("button", { class: "quiet", "aria-label": `Revoke ${one.name}`, onclick: () => revoke(one) }, "Revoke"),
  ]));
}

/** Show a new token, which the server does not show again. */
function showToken({ name, token }) {
  const field = h("input", { value: token, readonly: true, "aria-label": `Token ${name}`, onfocus: () => field.select() });
  const copy = navigator.clipboard && h("button", { onclick: () => act(() => navigator.clipboard.writeText(token)) }, "Copy"); // only with TLS, or on this computer
  const done = h("button", { class: "quiet", onclick: () => $("made").replaceChildren() }, "Done");
  $("made").replaceChildren(h("div", { class: "question fields" }, h("p", {}, `This is the token ${name}. It is not shown again: enter it now where it is needed, and keep it secret.`), field, h("div", { class: "row" }, ...[copy, done].filter(Boolean))));
  field.focus();
}

// -- settings -----------------------------------------------------------------------------------------------------------------

const TITLES = { servo: "Servo", table: "Table", mark: "Home mark", safety: "Safety", imu: "Gyro", head: "Rig head", camera: "Camera", camera_time: "Time of the camera", view: "Quality of views", catalog: "Catalog", enroll: "Enroll", identify: "Identify" };
const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);
const shown = (value) => (value === null ? "none" : Array.isArray(value) ? value.join(", ") : String(value));

/** Return what was typed as a value of the same kind as those before. */
function typed(field, key) {
  const text = field.value.trim();
  if (text === "" || text === "none") return null;
  if (typeof key.default === "boolean") return text === "true";
  const numbers = text.split(",").map(Number);
  if (typeof key.default === "string" || numbers.some(Number.isNaN)) return text;
  return Array.isArray(key.default) || numbers.length > 1 ? numbers : numbers[0];
}

if ($("settings")) {
  $("make-token").addEventListener("submit", (event) => {
    event.preventDefault();
    act(async () => {
      showToken(await request("POST", "/tokens", valuesOf($("make-token"))));
      $("make-token").reset();
      await loadTokens();
    });
  });
  let keys = [];
  const save = (key, value) => act(async () => {
    const before = key.saved ?? key.value;
    await request("PUT", `/settings/${key.key}`, { value });
    await load();
    toast(`${key.key} is ${shown(value)}.`, async () => { await request("PUT", `/settings/${key.key}`, { value: before }); await load(); });
  });
  const row = (key) => {
    const now = key.saved ?? key.value;
    const id = `set-${key.key}`;
    const choices = typeof key.default === "boolean" ? [["true", "yes"], ["false", "no"]] : key.choices.map((one) => [one, one]);
    const field = choices.length
      ? h("select", { id }, ...choices.map(([value, words]) => h("option", { value, selected: String(now) === value }, words)))
      : h("input", { id, value: shown(now) });
    const allowed = choices.length ? "" : `${key.allowed}${key.unit ? `, in ${key.unit}` : ""}; `;
    field.disabled = !key.editable || !canOperate();
    field.addEventListener("change", () => save(key, typed(field, key)));
    const waits = key.saved !== null && !same(key.saved, key.value);
    return h("div", { class: `setting${same(now, key.default) ? "" : " changed"}` },
      h("div", {}, h("label", { for: id }, h("strong", {}, key.key.split(".").at(-1).replaceAll("_", " "))), h("p", { class: "small" }, key.description), h("p", { class: "small soft" }, `${allowed}default ${shown(key.default)}${key.editable ? "" : "; changed at the bench's computer"}`), waits && h("p", { class: "small error" }, `In force now: ${shown(key.value)}. The new value counts after the server starts again.`)),
      h("div", { class: "row" }, field, key.editable && !same(now, key.default) && h("button", { class: "link", "aria-label": `Reset ${key.key}`, onclick: () => save(key, key.default) }, "Reset")));
  };
  const render = () => {
    const text = $("search").value.trim().toLowerCase();
    const found = keys.filter((key) => `${key.key} ${key.key.replaceAll("_", " ")} ${key.description}`.toLowerCase().includes(text) && (!$("changed").checked || !same(key.saved ?? key.value, key.default)));
    $("count").textContent = counted(found.length, "setting");
    const sections = [...new Set(found.map((key) => key.key.split(".").at(-2) || ""))];
    const part = (section) => found.filter((key) => (key.key.split(".").at(-2) || "") === section);
    const group = (section) => h("details", { class: "group", open: Boolean(text) || $("changed").checked || part(section)[0].editable }, h("summary", {}, TITLES[section] || "General"), ...part(section).map(row));
    const [here, there] = [sections.filter((section) => part(section).some((key) => key.editable)), sections.filter((section) => !part(section).some((key) => key.editable))];
    $("settings").replaceChildren(...here.reverse().map(group), ...(there.length ? [h("h2", { class: "wide" }, "Set at the bench's computer")] : []), ...there.map(group));
    const waiting = keys.filter((key) => key.saved !== null && !same(key.saved, key.value));
    $("restart").replaceChildren(...(waiting.length ? [h("span", {}, `Start the server again, so that ${waiting.map((key) => key.key).join(", ")} count.`)] : []));
  };
  const load = async () => {
    keys = (await get("/settings")).keys;
    const open = [...$("settings").querySelectorAll("details[open] > summary")].map((one) => one.textContent);
    render();
    for (const one of $("settings").querySelectorAll("details")) if (open.includes(one.firstChild.textContent)) one.open = true;
  };
  $("search").addEventListener("input", render);
  $("changed").addEventListener("change", render);
  on("hello", () => act(load));
  on("me", () => {
    const { name, role } = whoami();
    $("you").textContent = `${personOf(name) ? `User ${name}.` : "No login is needed here."} You may ${ROLES[role]}.`;
    $("logout").hidden = !personOf(name);
    $("tokens-section").hidden = !canOperate();
    $("make-token").hidden = !personOf(name); // then also the other users of this computer need no token
    if (canOperate()) act(loadTokens);
  });
  $("logout").addEventListener("click", () => act(async () => { await request("POST", "/logout"); location.assign("/login"); }));
}
start();
