import { $, act, ask, at, counted, h, on, pager, request, start, toast } from "./rig.js";
import { viewPicture } from "./pictures.js";

const load = pager(
  () => `/objects?${new URLSearchParams({ limit: "60", search: $("search").value, deleted: $("deleted").checked })}`,
  (page, isFirst) => {
    if (isFirst) $("objects").replaceChildren();
    $("count").textContent = counted(page.total, "object");
    $("objects").append(...page.items.map(card));
    if (!page.total) $("objects").append(h("li", { class: "empty" }, $("deleted").checked ? "No deleted object can be restored." : $("search").value ? "No object has this in its name, label or note." : "No object is enrolled yet. ", !$("deleted").checked && !$("search").value && h("a", { href: "/enroll" }, "Enroll the first one")));
  },
);

function card(one) {
  const deleted = $("deleted").checked;
  const views = one.unfinished_views !== null ? `interrupted, ${counted(one.unfinished_views, "view")}` : counted(one.views, "view");
  const parts = [
    one.picture === null ? null : h("img", { src: viewPicture(one.picture), alt: "", loading: "lazy" }),
    h("strong", {}, one.name),
    h("span", { class: "soft" }, deleted ? "Restore it" : `${one.label ? `${one.label}, ` : ""}${views}`),
  ];
  if (!deleted) return h("li", {}, h("a", { href: `/object?name=${at(one.name)}` }, ...parts));
  return h("li", {}, h("button", { onclick: () => act(async () => { await request("POST", "/undelete", { name: one.name }); await load(); toast(`${one.name} is restored.`); }) }, ...parts));
}

/** Import a bundle. Objects that exist already are a choice, not an error. */
async function upload(file, conflict = "reject") {
  let done;
  try {
    done = await request("POST", `/import?on_conflict=${conflict}`, file);
  } catch (problem) {
    if (conflict !== "reject" || problem.status !== 409) throw problem;
    const choice = await ask("Some of these objects exist already", h("p", {}, problem.message), [["skip", "Keep mine, import the others"], ["replace", "Replace mine", "quiet"]]);
    if (choice) await upload(file, choice);
    return;
  }
  toast(`Imported ${counted(done.objects, "object")} with ${counted(done.views, "view")}.`);
  await load();
}

$("find").addEventListener("submit", (event) => event.preventDefault());
let timer = null;
$("search").addEventListener("input", () => { clearTimeout(timer); timer = setTimeout(() => act(load), 200); });
$("deleted").addEventListener("change", () => act(load));
$("bundle").addEventListener("change", () => act(async () => { await upload($("bundle").files[0]); $("bundle").value = ""; }));
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
