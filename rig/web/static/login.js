import { $, nextSteps, request } from "./rig.js";

$("login").addEventListener("submit", async (event) => {
  event.preventDefault();
  try {
    await request("POST", "/login", { token: $("token").value });
    location.assign("/");
  } catch (problem) {
    $("login-error").replaceChildren(`${problem.message} `, ...nextSteps(problem.steps));
  }
});
