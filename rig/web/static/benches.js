// The overview of several benches; the server asks them.
import { $, act, h, on, request, start, stateWords, when } from "./rig.js";

const EVERY_MS = 3000;
const cards = new Map(); // they stay, so that a link keeps the focus

function card({ name, address }) {
  const parts = { state: h("p"), job: h("p"), answer: h("p") };
  $("benches").append(h("section", {}, h("h2", {}, h("a", { href: address }, name)), parts.state, parts.job, parts.answer));
  return parts;
}

async function load() {
  for (const one of (await request("GET", "/benches")).items) {
    if (!cards.has(one.name)) cards.set(one.name, card(one));
    const { state, job, answer } = cards.get(one.name);
    const [words, kind, why] = one.problem ? [`This bench ${one.problem}.`, "bad"] : stateWords(one.status);
    const time = one.answered_utc ? ` (${when(one.answered_utc)})` : "";
    state.className = kind === "bad" ? "error" : "";
    state.textContent = why || words;
    job.textContent = one.job ? `Job: ${one.job}` : "";
    answer.textContent = one.answer ? `Last answer: ${one.answer}${time}` : "";
  }
}

on("hello", () => act(load));
setInterval(() => { if (!document.hidden) act(load); }, EVERY_MS);
start();
