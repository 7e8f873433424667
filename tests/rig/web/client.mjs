// A client of the REST API that knows only its OpenAPI document. It prints what it has seen as JSON.
//
// node client.mjs URL TOKEN

import assert from "node:assert/strict";

const [base, token] = process.argv.slice(2);
const description = await (await fetch(`${base}/api/v1/openapi.json`)).json();
const operations = {};
for (const [path, methods] of Object.entries(description.paths)) {
  for (const [method, one] of Object.entries(methods)) operations[one.operationId] = { path, method, ...one };
}

/** Call an operation with the parameters that the document names; its answer must have a status of the document. */
async function call(name, { body, ...values } = {}) {
  const operation = operations[name];
  const headers = { Authorization: `Bearer ${token}` };
  let path = operation.path;
  for (const parameter of operation.parameters ?? []) {
    const value = values[parameter.name];
    if (value === undefined) assert(!parameter.required, `${name} needs ${parameter.name}`);
    else if (parameter.in === "path") path = path.replace(`{${parameter.name}}`, encodeURIComponent(value));
    else if (parameter.in === "header") headers[parameter.name] = value;
  }
  if (body !== undefined) headers["Content-Type"] = "application/json";
  const answer = await fetch(base + path, { method: operation.method.toUpperCase(), headers, body: JSON.stringify(body) });
  assert(String(answer.status) in operation.responses || `${String(answer.status)[0]}XX` in operation.responses);
  return answer;
}

const json = async (name, values) => (await call(name, values)).json();

/** Yield the messages of the event stream: kind and data. */
async function* messages(answer) {
  let text = "";
  for await (const chunk of answer.body.pipeThrough(new TextDecoderStream())) {
    const parts = (text + chunk).split("\n\n");
    text = parts.pop();
    for (const part of parts) {
      const fields = Object.fromEntries(part.split("\n").map((line) => [line.slice(0, line.indexOf(":")), line.slice(line.indexOf(":") + 2)]));
      if (fields.event) yield { kind: fields.event, data: JSON.parse(fields.data) };
    }
  }
}

const stream = messages(await call("stream_events"));
const events = [];

/** Return a job when it has one of the states; the events on the way are collected. */
async function reached(id, ...states) {
  while (true) {
    const { kind, data } = (await stream.next()).value;
    if (kind === "plan" && data.job === id) events.push(data);
    if (kind === "job" && data.id === id && states.includes(data.state)) return data;
  }
}

const run = async (request, ...states) => reached((await json("submit_job", { body: request })).id, ...states);

for (const name of ["mug-white", "lamp"]) {
  assert.equal((await run({ kind: "enroll", name, views: 4 }, "done", "failed")).state, "done");
}
const identified = await run({ kind: "identify", sample: "S-1" }, "done", "failed");
const { result } = events.find((one) => one.event === "recorded");
const image = await call("get_result_image", { result_id: result });
const bytes = new Uint8Array(await image.arrayBuffer());

const body = { kind: "home" };
const again = [];
for (let k = 0; k < 2; k++) again.push((await call("submit_job", { body, "idempotency-key": "cell-7" })).headers.get("location"));

const waiting = await run({ kind: "identify", scan: true }, "waiting");
const stopped = await json("stop");
await reached(waiting.id, "cancelled");
const cancelled = await json("get_job", { job_id: waiting.id });

const rejected = await call("submit_job", { body: { kind: "goto", angle_deg: 30000 } });
const problem = await rejected.json();
const [page, anchor] = problem.type.split("#");
const explained = await (await fetch(base + page)).text();

console.log(
  JSON.stringify({
    name: identified.result.name,
    kinds: [...new Set(events.map((one) => one.event))],
    result: await json("get_result", { result_id: result }),
    image: [image.headers.get("content-type"), bytes[0], bytes[1]],
    again,
    ended: stopped.ended,
    cancelled: cancelled.state,
    problem: [rejected.status, rejected.headers.get("content-type"), problem.code, problem.evidence.limits_deg],
    explained: explained.includes(`id="${anchor}"`),
  }),
);
process.exit(0);
