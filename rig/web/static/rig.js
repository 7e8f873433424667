// What all pages share: requests, events, the state of the bench, the lease, STOP, jobs, dialogs and toasts.

export const API = "/api/v1";
// All tabs of a browser are one operator. A private window has a store of its own.
const CLIENT = (() => {
  let id = localStorage.getItem("rig-client");
  if (!id) {
    id = Array.from(crypto.getRandomValues(new Uint8Array(12)), (b) => b.toString(16).padStart(2, "0")).join("");
    localStorage.setItem("rig-client", id);
  }
  return id;
})();

export const $ = (id) => document.getElementById(id);
const SVG = ["svg", "path", "rect", "circle", "line", "text", "g", "title", "polyline", "polygon"];

/** Return a new element. Attributes are an object (on… are listeners), children are nodes or text. */
export function h(tag, attributes = {}, ...children) {
  const element = SVG.includes(tag) ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/**
 * Replace the children of an element. A child that stays as it is remains the same element, so that it keeps the focus, a press
 * that has begun, and what was typed; the focus of another one passes to its successor.
 */
export function update(element, ...children) {
  const wanted = children.filter((child) => child !== null && child !== undefined && child !== false);
  wanted.forEach((child, k) => {
    const before = element.childNodes[k];
    if (!before) return element.append(child);
    if (before.isEqualNode(child)) return undefined;
    const focused = before.contains(document.activeElement);
    before.replaceWith(child);
    if (focused) (child.matches("button, a") ? child : child.querySelector("button, a"))?.focus();
    return undefined;
  });
  while (element.childNodes.length > wanted.length) element.lastChild.remove();
}

// -- words -------------------------------------------------------------------------------------------------------------

/** Return a number as people read it, with a minus sign; without decimals, with the digits that it has. */
export function number(value, decimals = null) {
  const digits = decimals === null ? String(value) : value.toFixed(decimals);
  return Number(digits) < 0 ? digits.replaceAll("-", "−") : digits.replace(/^-/, "");
}

/** Return "1 view", "2 views". */
export const counted = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;

/** Return a probability in percent; "<0.1 %" and ">99.9 %" at the ends. */
export function percent(probability) {
  if (probability > 0.999) return ">99.9 %";
  return probability < 0.001 ? "<0.1 %" : `${(100 * probability).toFixed(1)} %`;
}

/** Return "a, b or c". */
export const either = (words) => (words.length < 2 ? words.join("") : `${words.slice(0, -1).join(", ")} or ${words.at(-1)}`);

/** Return the name of an operator; none for a person at the bench's own computer, who needs no login. */
export const personOf = (name) => (name === "local" ? "" : name);

/** Return a time as people read it: "43 s", "2 min 05 s", "1 h 20 min". */
export function duration(seconds) {
  const s = Math.round(seconds);
  if (s < 60) return `${s} s`;
  const two = (count) => String(count).padStart(2, "0");
  return s < 3600 ? `${Math.floor(s / 60)} min ${two(s % 60)} s` : `${Math.floor(s / 3600)} h ${two(Math.floor((s % 3600) / 60))} min`;
}

const TIME = new Intl.DateTimeFormat(undefined, { hour: "2-digit", minute: "2-digit", hourCycle: "h23" });
const DAY = new Intl.DateTimeFormat(undefined, { weekday: "short", day: "numeric", month: "short", year: "numeric" });
export const timeOf = (utc) => TIME.format(new Date(utc));
export const dayOf = (utc) => DAY.format(new Date(utc));
/** Return a time in the zone of the browser, without the day if it is today. */
export const when = (utc) => (dayOf(utc) === DAY.format(new Date()) ? timeOf(utc) : `${dayOf(utc)}, ${timeOf(utc)}`);

const ACTIONS = JSON.parse($("actions").textContent);

/** Return the next steps of an error: sentences, and buttons or links for what a page can do. */
export function nextSteps(steps = []) {
  return steps.flatMap((step) => {
    if (typeof step === "string") return [`${step} `];
    const { words, job, page } = ACTIONS[step.action];
    const text = words.replace(/\{(\w+)\}/g, (_, key) => step.parameters[key] ?? key.toUpperCase());
    const label = text[0].toUpperCase() + text.slice(1);
    if (job) return [h("button", { onclick: () => submit({ ...job, ...step.parameters }) }, label), " "];
    if (page) return [h("a", { class: "button", href: page }, label), " "];
    return [step.command ? `${label}, at a terminal of the bench's computer: ` : `${label}. `, step.command && h("code", {}, step.command), " "];
  });
}

// -- requests ----------------------------------------------------------------------------------------------------------

/** An error with the fields of the server's problem. */
export class Problem extends Error {
  constructor(values) {
    super(values.detail || "The request failed.");
    Object.assign(this, values);
  }
}

/** Send a request and return the JSON of its answer. Throws a Problem. */
export async function request(method, path, body) {
  const headers = { "X-Rig-Client": CLIENT };
  const options = { method, headers, credentials: "same-origin" };
  if (body instanceof Blob) {
    options.body = body;
    headers["Content-Type"] = "application/zip";
  } else if (body !== undefined) {
    options.body = JSON.stringify(body);
    headers["Content-Type"] = "application/json";
  }
  let answer;
  try {
    answer = await fetch(API + path, options);
  } catch {
    throw new Problem({ detail: "The server does not answer.", steps: ["Check that the server runs."] });
  }
  if (answer.status === 401 && location.pathname !== "/login") location.assign("/login");
  const text = await answer.text();
  let values = {};
  try {
    values = text ? JSON.parse(text) : {};
  } catch {
    values = { detail: text };
  }
  if (!answer.ok) throw new Problem(values);
  return values;
}
export const get = (path) => request("GET", path);
export const at = encodeURIComponent;

/** Show an error until the next action. */
export function show(problem) {
  const box = $("messages");
  box.replaceChildren(h("p", {}, `${problem.message} `, ...nextSteps(problem.steps)));
  const mistakes = problem.evidence && problem.evidence.mistakes;
  if (mistakes) box.append(h("p", {}, mistakes.join("; ")));
  if (problem.code === 902) offerLease();
}

/** Run an action of the operator and return its result. Shows an error. */
export async function act(action) {
  $("messages").replaceChildren();
  try {
    return await action();
  } catch (problem) {
    show(problem);
    return undefined;
  }
}

export const submit = (values) => act(() => request("POST", "/jobs", values));

/** Return the values of a form by the names of its fields. An empty field is null. */
export function valuesOf(form) {
  const value = (field) => {
    if (field.type === "checkbox") return field.checked;
    if (field.value === "") return null;
    if (field.dataset.kind === "truth") return field.value === "true";
    return field.type === "number" ? Number(field.value) : field.value;
  };
  const given = [...form.elements].filter((field) => field.name && !field.disabled && (field.checked || (field.type !== "radio" && !("onlyTicked" in field.dataset))));
  return Object.fromEntries(given.map((field) => [field.name, value(field)]));
}

// A form or a button with data-job submits this kind of job. The names of the fields are the parameters of the job.
addEventListener("submit", (event) => {
  const { job } = event.target.dataset;
  if (!job) return;
  event.preventDefault();
  submit({ kind: job, ...valuesOf(event.target) });
});
addEventListener("click", ({ target }) => {
  if (target.matches?.("button[data-job]")) submit({ kind: target.dataset.job });
});

// -- dialogs and toasts ------------------------------------------------------------------------------------------------

/** Ask a question, and return the value of the chosen button, or null. STOP can be used meanwhile. */
export function ask(title, body, choices) {
  return new Promise((resolve) => {
    const buttons = choices.map(([value, label, kind]) => h("button", { class: kind, onclick: () => end(value) }, label));
    const dialog = h("dialog", { "aria-labelledby": "dialog-title" }, h("h2", { id: "dialog-title" }, title), h("div", {}, ...[body].flat()), h("div", { class: "row wide" }, ...buttons, h("button", { class: "quiet", onclick: () => end(null) }, "Cancel")));
    const before = document.activeElement;
    function end(value) {
      dialog.remove();
      before?.focus?.();
      resolve(value);
    }
    dialog.addEventListener("keydown", (event) => { if (event.key === "Escape") end(null); });
    document.body.append(dialog);
    dialog.show();
    (dialog.querySelector("input, textarea") || buttons[0]).focus();
  });
}

const TOAST_MS = 10000;
/** Say what was done, with a button that undoes it. */
export function toast(words, undo = null) {
  const box = h("div", { class: "toast" }, h("span", {}, words));
  if (undo) box.append(h("button", { onclick: () => { box.remove(); act(undo); } }, "Undo"));
  box.append(h("button", { "aria-label": "Close the message", onclick: () => box.remove() }, "✕"));
  $("toasts").append(box);
  setTimeout(() => { if (!box.contains(document.activeElement)) box.remove(); }, TOAST_MS);
}

// -- events ------------------------------------------------------------------------------------------------------------

const listeners = {};
export function on(kind, listener) {
  (listeners[kind] ||= []).push(listener);
}
const dispatch = (kind, data, id) => (listeners[kind] || []).forEach((listener) => listener(data, id));

let socket = null;
let lastId = null;
const RECONNECT_MS = 1500;

/**
 * Receive the server's events, and hold a connection on which STOP is sent. It is a web socket, because a browser opens
 * only six other connections to a server, for all its tabs together. A page that is left closes it.
 */
export function listen() {
  if (socket) return;
  const after = lastId === null ? "" : `&last=${at(lastId)}`;
  const mine = new WebSocket(`${location.origin.replace(/^http/, "ws")}${API}/socket?client=${CLIENT}${after}`);
  socket = mine;
  mine.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.kind === "stopped") return takeAnswer(message.data);
    lastId = message.id;
    return dispatch(message.kind, message.data, message.id);
  };
  mine.onclose = () => {
    if (socket !== mine) return; // this page was left
    socket = null;
    showState("No connection to the server. Trying again …", "bad");
    setTimeout(listen, RECONNECT_MS);
    get("/me").catch(() => {}); // without a valid token, the browser shows the login page
  };
}
addEventListener("pagehide", () => {
  const mine = socket;
  socket = null;
  mine?.close();
});
addEventListener("pageshow", (event) => {
  if (event.persisted) listen();
});

// -- state and lease ---------------------------------------------------------------------------------------------------

let me = null;
export const whoami = () => me;
export const canOperate = () => me !== null && me.role === "operate";

function showState(words, kind) {
  $("state").textContent = words;
  $("state").className = `state ${kind}`;
}

/** Return the state of the bench in words, whether it is good or bad, and the reason for a bad one. */
export function stateWords(status) {
  if (!status.open) return [status.error ? "Bench not available" : "Opening the bench …", "bad", status.error?.detail];
  if (status.fault) return [`Fault ${status.fault.code}`, "bad", status.fault.detail];
  if (status.doubt) return ["Angle in doubt", "bad", `The table's angle is in doubt: ${status.doubt}.`];
  const angle = status.table_deg === null || status.table_deg === undefined ? "" : `, table at ${number(status.table_deg, 1)}°`;
  return [`${status.job ? "Working" : "Ready"}${angle}`, status.job ? "good busy" : "good"];
}

let stepsShown = "";

/** Show what must be done before the bench works. A button that is pressed stays the same element. */
function showNextSteps(steps) {
  const values = JSON.stringify(steps);
  if (values === stepsShown) return;
  stepsShown = values;
  $("next-steps").replaceChildren(...(steps.length ? [h("p", {}, ...nextSteps(steps))] : []));
}

on("status", (status) => {
  const [words, kind, why] = stateWords(status);
  showState(words, kind);
  // The error of an open bench is about its list of jobs, and stops nothing.
  const listError = status.open && status.error ? [status.error.detail, ...status.error.steps] : [];
  const steps = status.open ? status.steps : status.error?.steps;
  showNextSteps([...(why ? [why] : []), ...(steps || []), ...listError]);
});

/** Say what the catalog's server does not have, and how old the local copy is. */
on("catalog", (state) => {
  const words = [...state.reasons];
  if (state.local_copy_utc) words.unshift(`The server of the catalog does not answer. The pages and searches use the copy of ${when(state.local_copy_utc)}.`);
  if (state.waiting) words.push(`Objects and answers in the journal of the bench's computer that the server does not have yet: ${state.waiting}.`);
  $("catalog-state").replaceChildren(...words.map((text) => h("p", {}, text)));
});

$("menu")?.addEventListener("click", () => $("menu").setAttribute("aria-expanded", $("menu").getAttribute("aria-expanded") !== "true"));

async function loadMe() {
  me = await get("/me");
  showLease(me.lease);
  dispatch("me", me);
}

function showLease(lease) {
  const mine = lease.client === CLIENT && lease.holder === me.name;
  $("lease").textContent = mine ? `You operate${personOf(me.name) && ` (${me.name})`}` : lease.holder ? `${personOf(lease.holder) || "Another browser"} operates` : "No operator";
  $("lease-button").hidden = !canOperate();
  $("lease-button").textContent = mine ? "Release" : "Operate";
  $("lease-button").setAttribute("aria-label", mine ? "Release the bench" : "Operate the bench");
  $("lease-button").dataset.mine = mine ? "1" : "";
}

on("lease", (lease) => {
  if (me === null) return;
  showLease(lease);
  if (lease.taken_from && lease.taken_from.name === me.name && lease.taken_from.client === CLIENT) show(new Problem({ detail: `${personOf(lease.holder) || "Another browser"} has taken over the bench.`, steps: ["You can watch."] }));
});

async function offerLease() {
  const words = h("p", {}, "Another operator uses the bench. If you take over, a running job continues, and the other operator sees a message.");
  if (await ask("Take over the bench?", words, [["force", "Take over", "danger"]])) act(() => request("POST", "/lease", { force: true }));
}

$("lease-button")?.addEventListener("click", () =>
  act(() => ($("lease-button").dataset.mine ? request("DELETE", "/lease") : request("POST", "/lease", {}))),
);
setInterval(() => {
  if ($("lease-button")?.dataset.mine) request("POST", "/lease", {}).catch(() => {});
}, 15000);

// -- STOP. The page says what the bench has confirmed; without that it warns after a second ------------------------------

const WARN_MS = 1000;
const SECOND_WAY_MS = 300;
const FIRST_AID = "NOT STOPPED: switch off the supply of the servo.";
let pressedAt = null;

function showStop(words, kind) {
  $("stop-state").replaceChildren(h("p", { class: kind }, words));
}

function showStopped() {
  const seconds = pressedAt === null ? "" : ` after ${((performance.now() - pressedAt) / 1000).toFixed(1)} s`;
  pressedAt = null;
  showStop(`Stopped${seconds}. The bench confirms that the torque is off. All jobs are cancelled.`, "confirmed");
}

/** Take an answer to STOP. If it came too early to confirm the stop, an event confirms it later. */
function takeAnswer(answer) {
  if (answer.ended) showStopped();
  else if (pressedAt !== null && answer.answer === "not-confirmed") showStop(`${FIRST_AID} The servo does not answer.`, "failed");
}

async function stopByRequest() {
  try {
    const answer = await fetch(`${API}/stop`, { method: "POST", headers: { "X-Rig-Client": CLIENT }, credentials: "same-origin", keepalive: true });
    const values = await answer.json();
    if (answer.ok) takeAnswer(values);
    else showStop(`${FIRST_AID} ${values.detail}`, "failed");
  } catch {
    if (pressedAt !== null) showStop(`${FIRST_AID} The server does not answer.`, "failed");
  }
}

$("stop")?.addEventListener("click", () => {
  const mine = performance.now();
  pressedAt = mine;
  showStop("Stopping …", "");
  const open = socket !== null && socket.readyState === WebSocket.OPEN;
  if (open) socket.send(JSON.stringify({ stop: mine }));
  setTimeout(() => { if (pressedAt === mine) stopByRequest(); }, open ? SECOND_WAY_MS : 0);
  setTimeout(() => { if (pressedAt === mine) showStop(FIRST_AID, "failed"); }, WARN_MS);
});
// Escape is STOP, too, because the Tab key needs too long to reach the button. Where it has its usual meaning, that comes first.
addEventListener("keydown", (event) => {
  if (event.key === "Escape" && !event.defaultPrevented && !event.target.closest("dialog, select, [type=search], [type=date]")) $("stop")?.click();
});

on("job", (job) => {
  if (job.state === "running" && $("stop-state").querySelector(".confirmed")) $("stop-state").replaceChildren();
});
on("stop", ({ ended, torque_off: torqueOff }) => {
  if (ended && torqueOff) showStopped();
  else if (ended) showStop(`${FIRST_AID} The servo does not answer.`, "failed");
  else if (pressedAt === null) showStop("Stopping …", "");
});

// -- a job -------------------------------------------------------------------------------------------------------------

const NAMES = { enroll: "Enroll", tray: "Enroll a tray", identify: "Identify", "empty-table": "Empty-table image", goto: "Rotate", home: "Rotate home", acknowledge: "Acknowledge", reference: "Set the angle", doctor: "Check the bench", calibrate: "Calibrate", camera: "Set the camera" };
const ENDED = ["done", "failed", "cancelled", "interrupted"];
const ACTIVE = ["running", "paused", "waiting"];
const STATES = { proposed: "waits for an approval", queued: "waits for the bench", waiting: "waits for you", failed: "not finished", cancelled: "stopped" };
const CHOICES = { continue: "Continue", restart: "Start again", skip: "Skip", stop: "End here" };
export const isEnded = (job) => ENDED.includes(job.state);

export function jobTitle(job) {
  const request_ = job.request;
  if (request_.kind === "retake") return `Take view ${request_.views.map((index) => index + 1).join(", ")} of ${request_.name} again`;
  const what = request_.name || (request_.angle_deg !== undefined ? `to ${number(request_.angle_deg)}°` : "");
  return `${NAMES[request_.kind] || request_.kind} ${what}`.trim();
}

// The jobs that the page knows. While a list of them is on its way, events tell newer states than its answer has.
const jobs = new Map();
const newer = new Set();
let loads = 0;
on("job", (job) => {
  newer.add(job.id);
  jobs.set(job.id, job);
  dispatch("jobs", job);
});
on("hello", () => act(async () => {
  const mine = (loads += 1);
  newer.clear();
  const lists = await Promise.all([get("/jobs?limit=50"), get("/jobs?state=proposed")]);
  if (mine !== loads) return; // the connection was lost again, and another list is on its way
  for (const id of jobs.keys()) if (!newer.has(id)) jobs.delete(id);
  for (const job of lists.flatMap(({ items }) => items)) if (!newer.has(job.id)) jobs.set(job.id, job);
  dispatch("jobs", null);
}));
const newestFirst = () => [...jobs.values()].sort((a, b) => (a.created_utc < b.created_utc ? 1 : -1));
export const newestOf = (some) => some.find((job) => ACTIVE.includes(job.state)) || some[0];

// -- proposed jobs: every page shows them, and an operator approves or rejects them ---------------------------------------

/** Return values with their names in words, such as "views: 24; replace". */
function details(values) {
  const words = (value) => (Array.isArray(value) ? value.map((one) => one.name ?? one).join(", ") : value);
  const given = Object.entries(values).filter(([, value]) => value !== false && String(value ?? "") !== "");
  return given.map(([key, value]) => `${key.replaceAll("_", " ")}${value === true ? "" : `: ${words(value)}`}`).join("; ");
}

function showProposals() {
  $("proposals").replaceChildren(...newestFirst().filter((job) => job.state === "proposed").reverse().map((job) => {
    const { kind, name: _name, angle_deg: _angle, ...others } = job.request;
    const more = kind === "retake" ? "" : details(others);
    const post = (what) => () => act(() => request("POST", `/jobs/${job.id}/${what}`));
    const buttons = [h("button", { onclick: post("approve") }, "Approve"), " ", h("button", { class: "quiet", onclick: post("cancel") }, "Reject")];
    return h("p", {}, h("strong", {}, job.operator), ` proposes: ${jobTitle(job)}${more && ` (${more})`}. `, ...(canOperate() ? buttons : ["It waits for an operator."]));
  }));
}

on("jobs", showProposals);
on("me", showProposals);

/** Show a job in a box: progress, question, buttons and, unless the page shows it elsewhere, the outcome. */
export function showJob(box, job, withOutcome = true) {
  if (!job) return box.replaceChildren();
  const asked = box.querySelector(".question");
  const post = (what, body) => () => act(() => request("POST", `/jobs/${job.id}/${what}`, body));
  const parts = [];
  if (!isEnded(job) || withOutcome) parts.push(h("p", {}, h("strong", {}, jobTitle(job)), ` – ${STATES[job.state] || job.state}`));
  if (job.progress && job.progress.total && !isEnded(job)) {
    const left = job.progress.seconds_left;
    const words = `${job.progress.done} of ${job.progress.total}${left ? `, about ${duration(left)} left` : ""}`;
    parts.push(h("progress", { max: job.progress.total, value: job.progress.done, "aria-label": words }), h("p", { class: "soft" }, words));
  }
  if (job.question) {
    const sample = job.question.takes_sample ? h("input", { "aria-label": "Sample", maxlength: 100, autocomplete: "off", onkeydown: (event) => { if (event.key === "Enter") post("answer", { choice: "continue", sample: event.target.value || null })(); } }) : null;
    const buttons = job.question.choices.map((choice) => h("button", { class: choice === "continue" ? "" : "quiet", onclick: () => post("answer", sample && choice === "continue" ? { choice, sample: sample.value || null } : { choice })() }, CHOICES[choice]));
    parts.push(h("div", { class: "question", "data-of": job.id }, h("p", {}, job.question.text), sample, h("p", {}, ...nextSteps(job.question.steps)), h("div", { class: "row" }, ...buttons)));
  }
  if (!isEnded(job) && job.state !== "proposed") {
    parts.push(
      h("div", { class: "row", "data-of": job.id },
        job.state === "running" && h("button", { class: "quiet", onclick: post("pause") }, "Pause"),
        job.state === "paused" && h("button", { onclick: post("resume") }, "Resume"),
        h("button", { class: "quiet", onclick: post("cancel") }, job.request.watch ? "Finish" : "Cancel")),
    );
  }
  if (withOutcome && job.result_text) parts.push(...job.result_text.split("\n").map((text) => h("p", {}, text)));
  if (withOutcome && job.error) parts.push(h("div", { class: "failure" }, h("p", { class: "error" }, job.error.detail), h("p", {}, ...nextSteps(job.error.steps)), h("p", { class: "small soft" }, `Error ${job.error.code}`)));
  if (job.resume && withOutcome) parts.push(h("div", { class: "row", "data-of": job.id }, h("button", { onclick: () => submit(job.resume) }, "Continue")));
  update(box, ...parts);
  const question = box.querySelector(".question");
  if (question !== asked) question?.querySelector("input")?.focus();
  return undefined;
}

/** Return the events of a job so far, and the id of the last one; of an old identification those of its saved run. */
async function eventsOf(job) {
  const found = await get(`/jobs/${job.id}/events`);
  if (found.items.length || !job.run || !isEnded(job)) return found;
  const run = await get(`/runs/${job.run}`).catch(() => ({ events: [] }));
  return { ...found, items: run.events };
}
const placeOf = (id) => Number(id.split("-").at(-1));

/**
 * Follow the newest job of these kinds. A page that is opened later sees the same as one that was open all the time:
 * `begin(job)`, then `event(event, job)` for all its events, and `render(job, loaded)` when the page has to change.
 */
export function followJob(kinds, { begin = () => {}, event = () => {}, render }) {
  let shown = null;
  let waiting = null; // events that came while those before them are loaded
  let opened = 0;
  async function open(job) {
    const mine = (opened += 1);
    shown = job;
    waiting = [];
    begin(job);
    render(job, false);
    const { items, last } = await eventsOf(job).catch(() => ({ items: [], last: "0" }));
    if (mine !== opened) return; // another job was opened meanwhile, or this one again
    for (const one of items) event(one, shown);
    for (const [one, id] of waiting) if (placeOf(id) > placeOf(last)) event(one, shown);
    waiting = null;
    render(shown, true);
  }
  // A proposed job is shown when it is approved; one that was cancelled before its start has done nothing.
  const counts = (job) => kinds.includes(job.request.kind) && job.state !== "proposed" && (job.state !== "cancelled" || job.started_utc || job.id === shown?.id);
  function take(job) {
    if (!counts(job)) return;
    if (shown?.id === job.id) {
      shown = job;
      render(job, !waiting);
    } else if (!shown || (job.created_utc >= shown.created_utc && (job.state !== "queued" || isEnded(shown)))) open(job);
  }
  on("jobs", (job) => {
    if (job) return take(job);
    shown = null;
    const newest = newestOf(newestFirst().filter(counts));
    return newest && open(newest);
  });
  on("plan", (one, id) => {
    if (one.job !== shown?.id) return;
    if (waiting) waiting.push([one, id]);
    else {
      event(one, shown);
      render(shown, true);
    }
  });
}

/** Show all jobs: the one that was chosen, or else the newest, and a list. Call `changed` with the shown one. */
export function listJobs(changed) {
  let open = null;
  const showAll = () => {
    const newest = newestFirst();
    const chosen = jobs.get(open) || newestOf(newest);
    showJob($("job"), chosen);
    if (chosen) changed(chosen);
    update($("jobs"),
      ...newest.slice(0, 8).map((job) => h("li", { "data-of": job.id }, h("button", { class: "link", onclick: () => { open = job.id; showAll(); } }, jobTitle(job)), ` ${[STATES[job.state] || job.state, when(job.created_utc), personOf(job.operator)].filter(Boolean).join(", ")}`)),
    );
  };
  on("jobs", (job) => {
    if (job?.state === "queued") open = null; // a new one is shown
    showAll();
  });
}

/** Say in the large words of a page how its job is, with details below. Words that stay are not announced again. */
export function headline(id, words, kind, ...detail) {
  if ($(id).textContent !== words) $(id).textContent = words;
  $(id).className = `answer ${kind}`;
  $(`${id}-detail`).replaceChildren(...detail.filter(Boolean));
}

/** Return a recorded answer in words, after its corrections. */
export const answerWords = ({ outcome, object }) => ({ found: object, ambiguous: `${object} or another`, unknown: "unknown object" }[outcome] || "no object");

/** Return a function that loads a list from its beginning. `add` gets its pages; the button #more loads the next one. */
export function pager(path, add) {
  let next = null;
  const load = async (more) => {
    const page = await get(path() + (more ? `&after=${at(next)}` : ""));
    next = page.next;
    $("more").hidden = next === null;
    add(page, !more);
  };
  $("more").addEventListener("click", () => act(() => load(true)));
  return () => load(false);
}

/** Return the terms and the descriptions of a list of definitions; without those that have no value. */
export const definitions = (rows) => rows.filter(([, value]) => value).flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]);

export function table(element, head, rows) {
  element.replaceChildren(
    h("thead", {}, h("tr", {}, ...head.map((text) => (text ? h("th", { scope: "col" }, text) : h("td", {}))))),
    h("tbody", {}, ...rows.map((row) => h("tr", {}, ...row.map((cell) => h("td", {}, cell instanceof Node ? cell : String(cell ?? "")))))),
  );
}

export async function start() {
  await act(loadMe); // without a valid token, the browser shows the login page
  on("hello", () => act(async () => {
    await loadMe();
    const status = await get("/status");
    dispatch("status", status);
    dispatch("catalog", status.catalog);
  }));
  listen();
}
