/** For who sees the panel of an exercise for the first time: one hint after another. */
const HINTS = [
  "Drag the probe over the skin to place it; drag down on the image to press.",
  "The dots on the skin are the points of the list; the image says force and press.",
  "Begin anew forgets what was done. Save the result keeps it as a page.",
];

export default {
  template: `
    <div class="us-steps">
      <div v-if="number < hints.length" class="row no-wrap us-step">
        <div class="us-note">{{ hints[number] }}</div>
        <q-btn flat dense round size="sm" icon="close" aria-label="Next hint" @click="number += 1" />
      </div>
    </div>`,
  data: () => ({ hints: HINTS, number: 0 }),
};
