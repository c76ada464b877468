/** What an exercise asks for next, above the image: on a small screen, too, where no panel is open. */

import { element, events } from "./events.js";
import { isOfOtherScene } from "./image.js";
import { stream } from "./stream.js";

let told = { scene: "", steps: [] };

/** How far the probe is from where a step is to be done, m; Infinity where it has no place. */
function distanceTo({ target = [], pose }) {
  const at = stream.latest("probe")?.header.position ?? [0, 0, 0];
  const places = pose ? [pose.slice(0, 3)] : target;
  return Math.min(...places.map((place) => Math.hypot(...place.map((value, i) => value - at[i]))));
}

export const exercise = {
  /** {what, seen, state, target, pose} of each; none where the exercise is of another scene. */
  get steps() {
    return isOfOtherScene(told.scene) ? [] : told.steps;
  },

  /** The step that is next: of those that are not done, the nearest to the probe; or undefined. */
  get next() {
    const left = this.steps.filter(({ state }) => state !== "done");
    return left.sort((a, b) => distanceTo(a) - distanceTo(b))[0];
  },
};

const line = Object.assign(document.createElement("p"), { className: "us-task", hidden: true });
line.setAttribute("role", "status");
(await element("ultrasound")).before(line);

function show() {
  const { steps, next } = exercise;
  line.hidden = !steps.length;
  line.classList.toggle("us-next", Boolean(next));
  const done = steps.filter(({ state }) => state === "done").length;
  const todo = next ? `${next.what}: ${next.seen}` : `${done} of ${steps.length} done`;
  const words = told.state === "to lift" ? told.words : todo;
  if (line.textContent !== words) line.textContent = line.title = words;
}

stream.on("score", (header) => {
  told = header;
  events.tell("exercise");
  show();
});
stream.watch("score");
stream.on("probe", show);
events.on("scene", show);
