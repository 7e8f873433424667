import { $, request } from "./rig.js";

$("login").addEventListener("submit", async (event) => {
  event.preventDefault();
  try {
    await request("POST", "/login", { token: $("token").value });
    location.assign("/");
  } catch (problem) {
    $("login-error").textContent = `${problem.message} ${problem.next_step || ""}`;
  }
});
