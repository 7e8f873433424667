import { $, API, act, canOperate, counted, h, on, pager, request, start } from "./rig.js";

let opened = null;
const path = (name) => encodeURIComponent(name);
const load = pager(
  () => `/objects?${new URLSearchParams({ limit: "60", search: $("search").value, deleted: $("deleted").checked })}`,
  (page, isFirst) => {
    if (isFirst) $("objects").replaceChildren();
    $("count").textContent = counted(page.total, "object");
    $("objects").append(...page.items.map(card));
  },
);

function card(one) {
  const views = one.unfinished_views !== null ? `interrupted, ${counted(one.unfinished_views, "view")}` : counted(one.views, "view");
  const image = one.picture === null ? null : h("img", { src: `${API}/views/${one.picture}/image`, alt: "", loading: "lazy" });
  const action = $("deleted").checked ? () => act(async () => { await request("POST", "/undelete", { name: one.name }); await load(); }) : () => act(() => open(one.name));
  return h("li", {}, h("button", { onclick: action }, image, h("strong", {}, one.name), h("br"), h("span", { class: "soft" }, $("deleted").checked ? "Restore" : `${one.label ? `${one.label}, ` : ""}${views}`)));
}

async function open(name) {
  const one = await request("GET", `/objects/${path(name)}`);
  opened = one.name;
  $("object-name").textContent = one.name;
  $("new-name").value = one.name;
  $("new-label").value = one.label;
  $("new-note").value = one.note;
  $("object-export").href = `${API}/export?name=${path(one.name)}`;
  const similar = one.similar ? one.similar.objects.map((other) => `${other.name} (similarity ${other.similarity.toFixed(2)})`).join(", ") : "";
  const enrollments = one.enrollments.map((e) => `${e.status}: ${e.stored_views} of ${e.planned_views} views, ${e.started_utc}${e.sessions.length ? `, bench ${e.sessions[0].bench}, ${e.sessions[0].software}` : ""}`);
  $("object-body").replaceChildren(
    h("p", {}, similar ? `Similar objects: ${similar}` : "No similar object."),
    h("ul", { class: "list" }, ...enrollments.map((words) => h("li", {}, words))),
    h("ol", { class: "thumbs" }, ...one.views_taken.map((view) => h("li", {}, h("img", { src: `${API}/views/${view.id}/image`, alt: "", loading: "lazy" }), `${view.azimuth_deg.toFixed(0)}°`))),
  );
  for (const element of $("edit").elements) if (element.id !== "close") element.disabled = !canOperate();
  $("object").show();
  $("object").scrollTop = 0;
}

async function upload(file) {
  const done = await request("POST", "/import", file);
  $("count").textContent = `Imported ${counted(done.objects, "object")} with ${counted(done.views, "view")}.`;
  await load();
}

$("find").addEventListener("submit", (event) => event.preventDefault());
let timer = null;
$("search").addEventListener("input", () => { clearTimeout(timer); timer = setTimeout(() => act(load), 200); });
$("deleted").addEventListener("change", () => act(load));
$("close").addEventListener("click", () => $("object").close());
$("edit").addEventListener("submit", (event) => {
  event.preventDefault();
  act(async () => {
    await request("PATCH", `/objects/${path(opened)}`, { name: $("new-name").value, label: $("new-label").value, note: $("new-note").value });
    $("object").close();
    await load();
  });
});
$("delete").addEventListener("click", () => act(async () => {
  await request("DELETE", `/objects/${path(opened)}`);
  $("object").close();
  await load();
}));
$("bundle").addEventListener("change", () => act(() => upload($("bundle").files[0])));
document.addEventListener("dragover", (event) => { event.preventDefault(); $("main").classList.add("drop"); });
document.addEventListener("dragleave", () => $("main").classList.remove("drop"));
document.addEventListener("drop", (event) => {
  event.preventDefault();
  $("main").classList.remove("drop");
  if (event.dataTransfer.files.length) act(() => upload(event.dataTransfer.files[0]));
});
on("hello", () => act(load));
on("plan", (event) => { if (event.event === "enrolled") act(load); });
start();
