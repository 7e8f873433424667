// The shelf of a simulated bench: the hands of a person who has no real one. A real bench has none, and shows nothing.
import { API, act, at, get, h, on, request, show, Problem } from "./rig.js";

const LIGHTS = [["0.25", "dim"], ["0.5", "half"], ["1", "normal"], ["1.5", "bright"]];

class RigShelf extends HTMLElement {
  connectedCallback() {
    on("hello", () => this.load());
    on("shelf", (state) => {
      if (state.error) show(new Problem(state.error));
      this.showState(state);
    });
    on("status", (status) => { if (status.open && !this.things) this.load(); });
  }

  async load() {
    const state = await get("/shelf").catch(() => null);
    if (!state) return;
    if (!this.things) this.build(state.things);
    this.showState(state);
  }

  build(things) {
    const use = (...words) => () => act(() => request("POST", "/shelf", { words }));
    this.things = new Map(things.map((name) => [name, h("button", { type: "button", onclick: use("put", name) }, h("img", { src: `${API}/shelf/${at(name)}`, alt: "", loading: "lazy" }), name)]));
    this.words = h("p", { class: "soft", role: "status" });
    this.light = h("select", { "aria-label": "Light", onchange: (event) => use("light", event.target.value)() }, ...LIGHTS.map(([value, words]) => h("option", { value }, `Light: ${words}`)));
    this.replaceChildren(h("section", { "aria-labelledby": "shelf-title" },
      h("h2", { id: "shelf-title" }, "Shelf of the simulated bench"), this.words,
      h("ul", { class: "shelf", tabindex: 0, "aria-labelledby": "shelf-title" }, ...[...this.things.values()].map((button) => h("li", {}, button))),
      h("div", { class: "row wide" }, h("button", { type: "button", class: "quiet", onclick: use("clear") }, "Clear the table"), this.light, h("button", { type: "button", class: "quiet", onclick: use("unplug") }, "Unplug the camera for 8 s"))));
  }

  showState(state) {
    if (!this.things) return;
    for (const [name, button] of this.things) button.setAttribute("aria-pressed", String(name === state.object));
    this.words.textContent = state.object ? `${state.object} is on the table, turned at random. Click another object to put it there instead.` : "The table is empty. Click an object to put it there.";
    this.light.value = String(state.light);
    this.dispatchEvent(new CustomEvent("changed", { detail: state, bubbles: true }));
  }
}
customElements.define("rig-shelf", RigShelf);
