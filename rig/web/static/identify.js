import { $, followJobs, h, nextSteps, number, on, percent, start } from "./rig.js";

function oneSample() {
  $("sample").disabled = $("watch").checked;
  $("sample-why").hidden = !$("watch").checked;
}
$("watch").addEventListener("change", oneSample);
oneSample(); // a browser that reloads the page can keep the tick

function answer(words, kind, ...detail) {
  $("answer").textContent = words;
  $("answer").className = `answer ${kind}`;
  $("answer-detail").replaceChildren(...detail);
}

/** Show an error. Code 606: the table is empty. */
export function noAnswer(error) {
  answer(error.code === 606 ? "No object on the table" : "No answer", "unknown", `${error.what} `, ...nextSteps(error.steps));
}

function clear() {
  for (const id of ["steps", "candidates", "shares"]) $(id).replaceChildren();
  answer("Searching …", "", "");
}

function bars(candidates, unknown = false) {
  const rows = candidates.slice(0, 6).flatMap((one) => {
    const share = one.probability ?? one.score;
    const words = one.probability === null ? number(one.score, 3) : percent(share);
    const bar = h("div", { "aria-hidden": "true" });
    bar.style.width = `${Math.max(share, 0) * 100}%`;
    return [h("span", {}, one.name), h("span", {}, bar), h("span", {}, words)];
  });
  $("candidates").replaceChildren(h("div", { class: "bar-chart" }, ...rows));
  const meaning = candidates[0].probability === null ? "Score per view." : "Shares among the enrolled objects.";
  $("shares").textContent = unknown ? `${meaning} The object on the table is none of them.` : meaning;
}

export function result(event) {
  const lines = event.text.split("\n");
  if (event.outcome === "found") answer(event.name, "found", lines[0]);
  else if (event.outcome === "ambiguous") answer(event.possible.join(" or "), "ambiguous", lines[0]);
  else answer("Unknown object", "unknown", lines[0]);
  bars(event.candidates, event.outcome === "unknown");
}

on("shown-plan", (event) => {
  if (event.event === "frame_used") return answer("Searching …", "", event.text.trim());
  if (event.event === "started") clear();
  if (event.event === "waiting") answer(event.reason === "first-object" ? "Put an object on the table" : "Put the next object on the table", "", "");
  if (event.event === "ranked") bars(event.candidates);
  if (event.event === "identified") result(event);
  if (event.event === "failed") noAnswer(event);
  if (event.text) for (const words of event.text.split("\n")) $("steps").append(h("li", {}, words.trim()));
  if (event.steps?.length) $("steps").append(h("li", {}, "Next step: ", ...nextSteps(event.steps)));
});
followJobs(["identify"], (job, isOther) => {
  if (isOther) {
    clear();
    if (job.state === "queued") answer("Waiting for the bench …", "", "");
  }
  if (job.result && job.result.event === "identified" && !job.request.watch) result({ ...job.result, text: job.result_text });
  if (job.state === "failed") noAnswer(job.error);
  if (["cancelled", "interrupted"].includes(job.state)) answer("Stopped", "", "");
}, (event) => `view ${event.index + 1}, ${event.azimuth_deg.toFixed(0)}°`);
start();
