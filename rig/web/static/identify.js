import { $, API, followJobs, h, nextSteps, number, on, percent, start } from "./rig.js";

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
  for (const id of ["steps", "candidates"]) $(id).replaceChildren();
  answer("Searching …", "", "");
}

/** Show the chart of the candidates after a number of views. The server draws it; its words are for screen readers. */
function chart(job, views, candidates, notEnrolled) {
  const words = candidates.map((one) => `${one.name} ${one.probability === null ? number(one.score, 3) : percent(one.probability)}`);
  if (typeof notEnrolled === "number") words.push(`not enrolled ${percent(notEnrolled)}`);
  $("candidates").replaceChildren(h("img", { src: `${API}/jobs/${job}/candidates?views=${views}`, alt: words.join(", ") }));
}

export function result(event) {
  const lines = event.text.split("\n").map((text) => h("p", {}, text));
  if (event.outcome === "found") answer(event.name, "found", ...lines);
  else if (event.outcome === "ambiguous") answer(event.possible.join(" or "), "ambiguous", ...lines);
  else answer("Unknown object", "unknown", ...lines);
  chart(event.job, event.views, event.candidates, event.not_enrolled);
}

on("shown-plan", (event) => {
  if (event.event === "frame_used") return answer("Searching …", "", event.text.trim());
  if (event.event === "started") clear();
  if (event.event === "waiting") answer(event.reason === "first-object" ? "Put an object on the table" : "Put the next object on the table", "", "");
  if (event.event === "ranked") chart(event.job, event.index + 1, event.candidates, event.decision?.not_enrolled);
  if (event.event === "identified") return result(event);
  if (event.event === "failed") noAnswer(event);
  if (event.text) for (const words of event.text.split("\n")) $("steps").append(h("li", {}, words.trim()));
  if (event.steps?.length) $("steps").append(h("li", {}, "Next step: ", ...nextSteps(event.steps)));
  return undefined;
});
followJobs(["identify"], (job, isOther) => {
  if (isOther) {
    clear();
    if (job.state === "queued") answer("Waiting for the bench …", "", "");
  }
  if (job.result && job.result.event === "identified" && !job.request.watch) result({ ...job.result, job: job.id, text: job.result_text });
  if (job.state === "failed") noAnswer(job.error);
  if (["cancelled", "interrupted"].includes(job.state)) answer("Stopped", "", "");
}, (event) => `view ${event.index + 1}, ${event.azimuth_deg.toFixed(0)}°`,
(job) => job.request.watch); // the wait for the next object replaces the answer above
start();
