/** What keys and gestures do, over the page; "?" shows and hides it. */

import { isTyping } from "./typing.js";

const PARTS = {
  "In the 3D view": [
    ["drag over the skin, click a number", "put the probe there"],
    ["drag the probe along itself", "press, lift"],
    ["drag the probe sideways", "slide"],
    ["Shift + drag the probe", "fan and rock"],
    ["wheel over the probe, Shift + wheel", "press, lift"],
    ["drag beside the patient, Alt + drag", "turn the view"],
    ["two fingers down, turned", "press, rotate"],
    ["Esc", "close the layers"],
  ],
  "On the image": [
    ["drag down, up; wheel", "press, lift"],
    ["drag sideways", "slide along the image"],
    ["Space", "freeze, go on"],
    ["C  ,  .", "play, step through the last 10 s"],
    ["D O T", "distance, ellipse, text"],
    ["Enter; Tab, arrows", "put it in the middle; move its points"],
    ["Esc, V, P", "no tool, compare, save"],
    ["X, Ctrl Z", "clear or have back, undo"],
  ],
  Keys: [
    ["← → ↑ ↓", "slide"],
    ["S W, Page ↓ ↑", "press, lift"],
    ["Q E", "rotate"],
    ["Shift + ↑ ↓", "fan"],
    ["Shift + ← →", "rock"],
    ["H L U", "centre, lift, upright"],
    ["0 to 6", "views"],
    ["← → on a slider", "a step less, more"],
    ["?", "this help"],
  ],
};

const dialog = document.createElement("dialog");
dialog.className = "us-help";
dialog.setAttribute("aria-label", "Keys and gestures");
for (const [title, lines] of Object.entries(PARTS)) {
  const part = document.createElement("section");
  const heading = Object.assign(document.createElement("h2"), { textContent: title });
  const list = document.createElement("dl");
  for (const [what, does] of lines) {
    list.append(
      Object.assign(document.createElement("dt"), { textContent: what }),
      Object.assign(document.createElement("dd"), { textContent: does }),
    );
  }
  part.append(heading, list);
  dialog.append(part);
}
const closing = Object.assign(document.createElement("button"), { type: "button" });
closing.textContent = "Close";
dialog.prepend(closing);
document.body.append(dialog);
dialog.addEventListener("click", () => dialog.close());

export const help = {
  /** Show it, or hide it. */
  toggle() {
    if (dialog.open) dialog.close();
    else dialog.showModal();
  },
};

addEventListener("keydown", (event) => {
  if (event.key === "?" && (dialog.open || !isTyping(event))) help.toggle();
});
