// What all pages share: requests, events, the state of the bench, the lease and STOP.

export const API = "/api/v1";
const CLIENT = (() => {
  let id = sessionStorage.getItem("rig-client");
  if (!id) {
    id = Array.from(crypto.getRandomValues(new Uint8Array(12)), (b) => b.toString(16).padStart(2, "0")).join("");
    sessionStorage.setItem("rig-client", id);
  }
  return id;
})();

export const $ = (id) => document.getElementById(id);

/** Return a new element. Attributes are an object (on… are listeners), children are nodes or text. */
export function h(tag, attributes = {}, ...children) {
  const svg = ["path", "rect"].includes(tag);
  const element = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

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
function valuesOf(form) {
  const value = (field) => {
    if (field.type === "checkbox") return field.checked;
    if (field.value === "") return null;
    return field.type === "number" ? Number(field.value) : field.value;
  };
  return Object.fromEntries([...form.elements].filter((field) => field.name && !field.disabled).map((field) => [field.name, value(field)]));
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

// -- events -----------------------------------------------------------------------------------------------------------

const listeners = {};
export function on(kind, listener) {
  (listeners[kind] ||= []).push(listener);
}
const dispatch = (kind, data) => (listeners[kind] || []).forEach((listener) => listener(data));

let socket = null;
let lastId = null;
const RECONNECT_MS = 1500;

/**
 * Receive the server's events, and hold a connection on which STOP is sent. It is a web socket, because a browser opens
 * only six other connections to a server, for all its tabs together. A page that is left closes it.
 */
export function listen() {
  if (socket) return;
  const after = lastId === null ? "" : `&last=${encodeURIComponent(lastId)}`;
  const mine = new WebSocket(`${location.origin.replace(/^http/, "ws")}${API}/socket?client=${CLIENT}${after}`);
  socket = mine;
  mine.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    if (message.kind === "stopped") return takeAnswer(message.data);
    lastId = message.id;
    return dispatch(message.kind, message.data);
  };
  mine.onclose = () => {
    if (socket !== mine) return; // this page was left
    socket = null;
    $("state").textContent = "No connection to the server. Trying again …";
    $("state").className = "state bad";
    setTimeout(listen, RECONNECT_MS);
    request("GET", "/me").catch(() => {}); // without a valid token, the browser shows the login page
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

// -- state, lease, STOP -------------------------------------------------------------------------------------------------

let me = null;
export const whoami = () => me;
export const canOperate = () => me !== null && me.role === "operate";

/** Return the state of the bench in words, and whether it is good or bad. */
export function stateWords(status) {
  if (!status.open) return [status.error ? `Bench not available: ${status.error.what}` : "Opening the bench …", "bad"];
  if (status.fault) return [`Fault ${status.fault.code}: ${status.fault.what}`, "bad"];
  if (status.doubt) return [`The table's angle is in doubt: ${status.doubt}.`, "bad"];
  const angle = status.table_deg === null || status.table_deg === undefined ? "" : `, table at ${number(status.table_deg, 1)}°`;
  return [`${status.job ? "Working" : "Ready"}${angle}`, "good"];
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
  showNextSteps((status.error ? status.error.steps : status.steps) || []);
  const [words, kind] = stateWords(status);
  $("state").textContent = words;
  $("state").className = `state ${kind}`;
});

/** Say what the catalog's server does not have, and how old the local copy is. */
on("catalog", (state) => {
  const words = [...state.reasons];
  if (state.local_copy_utc) words.unshift(`The server of the catalog does not answer. The pages and searches use the copy of ${state.local_copy_utc}.`);
  if (state.waiting) words.push(`Objects and answers in the journal of the bench's computer that the server does not have yet: ${state.waiting}.`);
  $("catalog-state").replaceChildren(...words.map((text) => h("p", {}, text)));
});

async function loadMe() {
  me = await request("GET", "/me");
  showLease(me.lease);
  dispatch("me", me);
}

function showLease(lease) {
  const mine = lease.client === CLIENT && lease.holder === me.name;
  $("lease").textContent = mine ? `You operate (${me.name})` : lease.holder ? `${lease.holder} operates` : "No operator";
  $("lease-button").hidden = !canOperate();
  $("lease-button").textContent = mine ? "Release the bench" : "Operate";
  $("lease-button").dataset.mine = mine ? "1" : "";
}

on("lease", (lease) => {
  if (me === null) return;
  showLease(lease);
  if (lease.taken_from && lease.taken_from.name === me.name && lease.taken_from.client === CLIENT) show(new Problem({ detail: `${lease.holder} has taken over the bench.`, steps: ["You can watch."] }));
});

function offerLease() {
  $("lease-text").textContent = "Another operator uses the bench. If you take over, a running job continues, and the other operator sees a message.";
  const dialog = $("lease-dialog");
  dialog.onclose = () => {
    if (dialog.returnValue === "force") act(() => request("POST", "/lease", { force: true }));
  };
  dialog.show();
}

$("lease-button")?.addEventListener("click", () =>
  act(() => ($("lease-button").dataset.mine ? request("DELETE", "/lease") : request("POST", "/lease", {}))),
);
setInterval(() => {
  if ($("lease-button")?.dataset.mine) request("POST", "/lease", {}).catch(() => {});
}, 15000);

// STOP. The page says what the bench has confirmed; without that it warns after a second.

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

on("job", (job) => {
  if (job.state === "running" && $("stop-state").querySelector(".confirmed")) $("stop-state").replaceChildren();
});
on("stop", ({ ended, torque_off: torqueOff }) => {
  if (ended && torqueOff) showStopped();
  else if (ended) showStop(`${FIRST_AID} The servo does not answer.`, "failed");
  else if (pressedAt === null) showStop("Stopping …", "");
});

// -- a job ---------------------------------------------------------------------------------------------------------------

const NAMES = { enroll: "Enroll", tray: "Enroll a tray", identify: "Identify", "empty-table": "Empty-table image", goto: "Rotate", home: "Rotate home", acknowledge: "Acknowledge", reference: "Set the angle", doctor: "Check the bench", calibrate: "Calibrate" };
const ENDED = ["done", "failed", "cancelled", "interrupted"];
const ACTIVE = ["running", "paused", "waiting"];
const CHOICES = { continue: "Continue", restart: "Start again", skip: "Skip", stop: "Stop" };

function jobTitle(job) {
  const request_ = job.request;
  const what = request_.name || (request_.angle_deg !== undefined ? `to ${number(request_.angle_deg)}°` : "");
  return `${NAMES[request_.kind] || request_.kind} ${what}`.trim();
}

/** Return a time as people read it: "43 s", "2 min 05 s", "1 h 20 min". */
export function duration(seconds) {
  const s = Math.round(seconds);
  if (s < 60) return `${s} s`;
  const two = (count) => String(count).padStart(2, "0");
  return s < 3600 ? `${Math.floor(s / 60)} min ${two(s % 60)} s` : `${Math.floor(s / 3600)} h ${two(Math.floor((s % 3600) / 60))} min`;
}

/** Show a job in a box: progress, question, buttons and, unless the page shows it elsewhere, the outcome. */
function showJob(box, job, withOutcome = true) {
  if (!job) return box.replaceChildren();
  const post = (what, body) => () => act(() => request("POST", `/jobs/${job.id}/${what}`, body));
  const parts = [h("p", {}, h("strong", {}, jobTitle(job)), ` – ${job.state}`)];
  const ended = ENDED.includes(job.state);
  if (job.progress && job.progress.total && !ended) {
    const left = job.progress.seconds_left;
    const words = `${job.progress.done} of ${job.progress.total}${left ? `, about ${duration(left)} left` : ""}`;
    parts.push(h("progress", { max: job.progress.total, value: job.progress.done, "aria-label": words }), h("p", {}, words));
  }
  if (job.question) {
    const buttons = job.question.choices.map((choice) => h("button", { class: choice === "continue" ? "big" : "quiet", onclick: post("answer", { choice }) }, CHOICES[choice]));
    parts.push(h("div", { class: "question" }, h("p", {}, job.question.text), h("p", {}, ...nextSteps(job.question.steps)), h("div", { class: "row" }, ...buttons)));
  }
  if (!ended) {
    parts.push(
      h("div", { class: "row" },
        job.state === "running" && h("button", { class: "quiet", onclick: post("pause") }, "Pause"),
        job.state === "paused" && h("button", { onclick: post("resume") }, "Resume"),
        h("button", { class: "quiet", onclick: post("cancel") }, "Cancel")),
    );
  }
  if (withOutcome && job.result_text) parts.push(...job.result_text.split("\n").map((text) => h("p", {}, text)));
  if (withOutcome && job.error) parts.push(h("p", { class: "error" }, `Error ${job.error.code}: ${job.error.what}`), h("p", {}, "Next step: ", ...nextSteps(job.error.steps)));
  if (job.resume) {
    parts.push(h("div", { class: "row" }, h("button", { onclick: () => submit(job.resume) }, "Continue")));
  }
  box.replaceChildren(...parts);
  return undefined;
}

const loadJobs = async () => (await request("GET", "/jobs?limit=50")).items;
const newestOf = (jobs) => jobs.find((job) => ACTIVE.includes(job.state)) || jobs[0];

/**
 * Show the newest job of these kinds: its state, its views and, where `withOutcome` allows it, its outcome. Call `changed`
 * with it, and whether it is another one.
 */
export function followJobs(kinds, changed = () => {}, viewWords = null, withOutcome = () => true) {
  let shown = null;
  const add = (number, words) => $("thumbs").append(h("li", {}, h("img", { src: `${API}/jobs/${shown.id}/views/${number}`, alt: "", loading: "lazy" }), words));
  const take = (job) => {
    const isOther = !shown || shown.id !== job.id;
    if (!kinds.includes(job.request.kind)) return;
    if (shown && isOther && (job.created_utc < shown.created_utc || (job.state === "queued" && !ENDED.includes(shown.state)))) return;
    shown = job;
    showJob($("job"), job, withOutcome(job));
    if (isOther && viewWords) { // a page that was opened in the middle of a job shows the views so far
      $("thumbs").replaceChildren();
      for (let k = 0; k < job.views; k += 1) add(k, `view ${k + 1}`);
    }
    changed(job, isOther);
  };
  on("job", take);
  on("hello", () => act(async () => {
    const newest = newestOf((await loadJobs()).filter((job) => kinds.includes(job.request.kind)));
    if (newest) take(newest);
  }));
  on("plan", (event) => {
    if (event.job !== shown?.id) return;
    if (viewWords && event.event === "started") $("thumbs").replaceChildren();
    if (viewWords && event.event === "accepted") add(event.picture, viewWords(event));
    dispatch("shown-plan", event);
  });
}

/** Show all jobs: the one that was chosen, or else the newest, and a list. Call `changed` with the shown one. */
export function listJobs(changed) {
  const jobs = new Map();
  let open = null;
  const showAll = () => {
    const newest = [...jobs.values()].sort((a, b) => (a.created_utc < b.created_utc ? 1 : -1));
    const chosen = jobs.get(open) || newestOf(newest);
    showJob($("job"), chosen);
    if (chosen) changed(chosen);
    $("jobs").replaceChildren(
      ...newest.slice(0, 12).map((job) => h("li", {}, h("button", { class: "quiet", onclick: () => { open = job.id; showAll(); } }, jobTitle(job)), ` ${job.state}, ${job.operator}, ${job.created_utc}`)),
    );
  };
  on("job", (job) => {
    if (!jobs.has(job.id)) open = null;
    jobs.set(job.id, job);
    showAll();
  });
  on("hello", () => act(async () => {
    for (const job of await loadJobs()) jobs.set(job.id, job);
    showAll();
  }));
}

/** Return a function that loads a list from its beginning. `add` gets its pages; the button #more loads the next one. */
export function pager(path, add) {
  let next = null;
  const load = async (more) => {
    const page = await request("GET", path() + (more ? `&after=${encodeURIComponent(next)}` : ""));
    next = page.next;
    $("more").hidden = next === null;
    add(page, !more);
  };
  $("more").addEventListener("click", () => act(() => load(true)));
  return () => load(false);
}


export function table(element, head, rows) {
  element.replaceChildren(
    h("thead", {}, h("tr", {}, ...head.map((text) => h("th", { scope: "col" }, text)))),
    h("tbody", {}, ...rows.map((row) => h("tr", {}, ...row.map((cell) => h("td", {}, cell instanceof Node ? cell : String(cell ?? "")))))),
  );
}

export async function start() {
  await act(loadMe); // without a valid token, the browser shows the login page
  on("hello", () => act(async () => {
    await loadMe();
    const status = await request("GET", "/status");
    dispatch("status", status);
    dispatch("catalog", status.catalog);
  }));
  listen();
}
