/** How a person does what an exercise asks for at the moment. */

const LIFT = "Press Lift below the 3D view, or key L.";
const LAND = "Drag down on the image until the probe touches the skin.";
const LAND_ON_POINT =
  "Click a number to move the probe over that point; drag down on the image until it touches.";
const PRESS = "Drag down on the image to press harder, up to press less.";
const SLIDE = "Drag sideways on the image to slide the probe along it.";
const COMPRESS =
  "Drag down on the image to press, up to let go. Then press Lift, and click the next number.";
const END = "Begin anew starts another attempt; Save the result keeps this one as a page.";

export default {
  template: `
    <div v-if="!isClosed" class="row no-wrap us-step">
      <q-icon name="lightbulb" />
      <div class="us-note">{{ hint }}</div>
      <q-btn flat dense round size="sm" icon="close" aria-label="No hints" @click="isClosed = true" />
    </div>`,
  props: {
    state: String, // of the attempt, see STATES of the scorer
    dots: Number, // of the step that has most: 1 of a point, more of a line, 0 where any place does
  },
  data: () => ({ isClosed: false }),
  computed: {
    hint() {
      const { state, dots } = this;
      if (state === "to lift") return LIFT;
      if (state === "to do") return dots === 1 ? LAND_ON_POINT : LAND;
      if (state !== "running") return END;
      if (dots === 1) return COMPRESS;
      return dots ? SLIDE : PRESS;
    },
  },
};
