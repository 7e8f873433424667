import { $, API, act, answerWords, ask, at, canOperate, counted, get, h, on, pager, percent, personOf, request, start, table, toast, when } from "./rig.js";
import { picture } from "./pictures.js";

const RUN_S = 1800; // a search that takes longer than this has no report here

let rows = [];
let runs = [];
const wanted = new URLSearchParams(location.search).get("result");
let opened = false;

const kind = (one) => ({ found: "good", ambiguous: "amber", unknown: "amber" }[one.outcome] || "");
const dateOf = (time) => time.toLocaleDateString("sv"); // year, month and day, of this place
const day = (one) => dateOf(new Date(one.time_utc));

function matching() {
  const text = $("search").value.trim().toLowerCase();
  const outcome = $("outcome").value;
  return rows.filter((one) => {
    if (outcome === "corrected" ? !one.corrections : outcome && one.outcome !== outcome) return false;
    if (($("since").value && day(one) < $("since").value) || ($("until").value && day(one) > $("until").value)) return false;
    return `${one.object ?? ""} ${one.sample ?? ""} ${one.operator ?? ""}`.toLowerCase().includes(text);
  });
}

function render() {
  const found = matching();
  $("count").textContent = counted(found.length, "answer");
  table($("answers"), ["", "Answer", "Sample", "Sure", "Views", "Time", "Operator", ""], found.map((one) => [
    one.image ? h("img", { src: `${API}/results/${one.id}/image`, alt: "", loading: "lazy" }) : "",
    h("span", {}, h("span", { class: `tag ${kind(one)}` }, answerWords(one)), one.corrections > 0 && h("span", { class: "soft small" }, ` corrected, was ${one.answered_object || one.answered_outcome}`)),
    one.sample || "",
    one.outcome === "found" && one.confidence !== null ? percent(one.confidence) : "",
    one.views,
    when(one.time_utc),
    personOf(one.operator),
    h("button", { class: "quiet", "aria-label": `Details of answer ${one.id}`, onclick: () => act(() => open(one)) }, "Details"),
  ]));
  if (!rows.length) $("answers").replaceChildren(h("tbody", {}, h("tr", {}, h("td", { class: "empty" }, "There is no answer yet. ", h("a", { href: "/identify" }, "Identify an object")))));
}

// -- one answer -----------------------------------------------------------------------------------------------------------

/** Return the saved run of an answer: the last one that began before it. Its name has the time of its beginning. */
function runOf(one) {
  const time = new Date(one.time_utc).getTime();
  const begun = (name) => Date.parse(name.replace(/^(\d{4})(\d\d)(\d\d)-(\d\d)(\d\d)(\d\d).*/, "$1-$2-$3T$4:$5:$6Z"));
  return runs.find((name) => begun(name) <= time && begun(name) > time - 1000 * RUN_S);
}

async function open(one) {
  const run = runOf(one);
  const pictures = h("div", { class: "pair" },
    one.image ? picture(`${API}/results/${one.id}/image?full=true`, "The first view", "First view") : h("p", { class: "soft" }, "No image was recorded."),
    one.object ? picture(`${API}/pose-picture?object=${at(one.object)}`, `${one.object} as enrolled`, one.object, " as enrolled") : h("span"));
  const facts = h("p", { class: "small soft" }, [when(one.time_utc), personOf(one.operator), counted(one.views, "view"), one.sample && `sample ${one.sample}`, one.correction_reason && `corrected by ${one.corrected_by}: ${one.correction_reason}`].filter(Boolean).join(", "));
  const check = async () => {
    const { views, decisions } = await request("POST", `/runs/${run}/check`);
    toast(`Computed again: ${counted(views, "view")} and ${counted(decisions, "decision")}. All are as saved.`);
  };
  const links = run ? [h("div", { class: "row" }, h("a", { class: "button", href: `${API}/runs/${run}/report`, target: "_blank" }, "Open the report"), h("button", { class: "quiet", onclick: () => act(check) }, "Compute it again"))] : [];
  const choice = await ask(`Answer ${one.id}: ${answerWords(one)}`, [pictures, facts, ...links], canOperate() ? [["correct", "Correct it", "quiet"]] : []);
  if (choice === "correct") await correct(one);
}

async function correct(one) {
  const { items } = await get("/objects?limit=500");
  const object = h("select", { id: "right-object" }, h("option", { value: "" }, "an unknown object"), ...items.map((other) => h("option", { value: other.name, selected: other.name === one.object }, other.name)));
  const [sample, reason] = [h("input", { id: "right-sample", value: one.sample ?? "", maxlength: 100 }), h("input", { id: "right-reason", maxlength: 1000, required: true })];
  const fields = h("div", { class: "fields" }, h("label", { for: "right-object" }, "It is"), object, h("label", { for: "right-sample" }, "Sample"), sample, h("label", { for: "right-reason" }, "Reason"), reason, h("p", { class: "small soft" }, "The answer itself stays in the record."));
  if ((await ask(`Correct answer ${one.id}`, fields, [["save", "Save the correction"]])) !== "save") return;
  await act(async () => {
    await request("POST", `/results/${one.id}/correct`, { reason: reason.value, object: object.value || null, unknown: !object.value, ...(sample.value !== (one.sample ?? "") && { sample: sample.value }) });
    await load();
    toast(`Answer ${one.id} is corrected.`);
  });
}

// -- the list ---------------------------------------------------------------------------------------------------------------

$("csv").addEventListener("click", () => {
  const columns = ["id", "time_utc", "sample", "outcome", "object", "confidence", "score", "views", "operator", "corrections", "correction_reason"];
  const cell = (value) => (/[",\n;]/.test(String(value ?? "")) ? `"${String(value).replaceAll('"', '""')}"` : String(value ?? ""));
  const text = [columns, ...matching().map((one) => columns.map((key) => one[key]))].map((line) => line.map(cell).join(",")).join("\r\n");
  const link = h("a", { href: URL.createObjectURL(new Blob([`\ufeff${text}`], { type: "text/csv" })), download: `answers-${dateOf(new Date())}.csv` });
  link.click();
  URL.revokeObjectURL(link.href);
});
$("find").addEventListener("submit", (event) => event.preventDefault());
for (const id of ["search", "outcome", "since", "until"]) $(id).addEventListener("input", render);
const load = pager(() => "/results?limit=500", ({ items }, isFirst) => {
  rows = isFirst ? items : [...rows, ...items];
  render();
  $("charts").hidden = !rows.length;
  if (!rows.length) return;
  const zone = -new Date().getTimezoneOffset();
  for (const name of ["days", "drift"]) $(name).src = `${API}/results/charts/${name}?zone_min=${zone}&answers=${rows[0]?.id ?? 0}`;
});
on("hello", () => act(async () => {
  runs = (await get("/runs?limit=500")).items;
  await load();
  const one = rows.find((row) => row.id === wanted);
  if (one && !opened) {
    opened = true;
    await open(one);
  }
}));
on("plan", (event) => { if (event.event === "recorded") act(load); });
start();
