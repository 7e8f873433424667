// The overview of several benches; the server asks them.
import { $, act, h, on, request, start, stateWords, table } from "./rig.js";

const EVERY_MS = 3000;

async function load() {
  const { items } = await request("GET", "/benches");
  table($("benches"), ["Bench", "State", "Job", "Last answer", "Time"], items.map((one) => {
    const [words, kind] = one.problem ? [one.problem, "bad"] : stateWords(one.status);
    const time = one.answered_utc ? new Date(one.answered_utc).toLocaleTimeString() : "";
    return [h("a", { href: one.address }, one.name), h("span", { class: `state ${kind}` }, words), one.job, one.answer, time];
  }));
}

on("hello", () => act(load));
setInterval(() => { if (!document.hidden) act(load); }, EVERY_MS);
start();
