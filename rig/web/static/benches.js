// The overview of several benches; the server asks them.
import { $, act, get, h, on, start, stateWords, update, when } from "./rig.js";

const EVERY_MS = 3000;

function card({ name, address, problem, status, job, answer, answered_utc: answered }) {
  const [words, kind, why] = problem ? [`This bench ${problem}.`, "bad"] : stateWords(status);
  return h("section", {}, h("h2", {}, h("a", { href: address }, name)),
    h("p", { class: kind === "bad" ? "error" : "" }, why || words),
    job && h("p", {}, `Job: ${job}`),
    answer && h("p", {}, `Last answer: ${answer}${answered ? ` (${when(answered)})` : ""}`));
}

const load = async () => update($("benches"), ...(await get("/benches")).items.map(card));
on("hello", () => act(load));
setInterval(() => { if (!document.hidden) act(load); }, EVERY_MS);
start();
