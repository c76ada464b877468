/**
 * One quantity over the last minute, a line for each node: axes with units, drawn as SVG.
 *
 * The server sends the points that are new; those older than `SPAN` are forgotten here.
 */
const SPAN = 60; // s
const WIDTH = 350; // px, as are the following
const HEIGHT = 118;
const LEFT = 44;
const RIGHT = 8;
const TOP = 8;
const BOTTOM = 20;
const LINES = ["#4fb3bf", "#d7dde2", "#c9b458", "#8aa0d0", "#8f9aa3"];
const SECONDS = [-60, -40, -20, 0];

/** The next of 1, 2, 5 times a power of ten that is not smaller. */
function roundUp(number) {
  const power = 10 ** Math.floor(Math.log10(number));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= number * (1 - 1e-9));
}

export default {
  template: `
    <figure class="us-plot">
      <figcaption>
        <span>{{ title }}<span v-if="unit">, {{ unit }}</span></span>
        <span v-for="line in lines" class="us-key">
          <svg width="14" height="8" aria-hidden="true">
            <line x1="0" y1="4" x2="14" y2="4" :stroke="line.colour" stroke-width="2"
              :stroke-dasharray="line.dash" />
          </svg>
          {{ line.name }} <b>{{ line.last }}</b>
        </span>
      </figcaption>
      <svg :viewBox="'0 0 ${WIDTH} ${HEIGHT}'" role="img" :aria-label="spoken">
        <g v-for="tick in levels">
          <line x1="${LEFT}" x2="${WIDTH - RIGHT}" :y1="tick.y" :y2="tick.y" class="us-grid" />
          <text x="${LEFT - 5}" :y="tick.y + 4" text-anchor="end">{{ tick.text }}</text>
        </g>
        <text v-for="tick in times" :x="tick.x" y="${HEIGHT - 5}" :text-anchor="tick.anchor">
          {{ tick.text }}
        </text>
        <path v-for="line in lines" :d="line.path" fill="none" :stroke="line.colour"
          :stroke-dasharray="line.dash" stroke-width="1.5" stroke-linejoin="round" />
      </svg>
    </figure>`,
  props: { title: String, unit: String, logarithmic: Boolean },
  data: () => ({ series: {}, now: 0 }),
  computed: {
    range() {
      const values = Object.values(this.series).flatMap((points) => points.map((each) => each[1]));
      if (this.logarithmic) {
        const powers = values.filter((value) => value > 0).map(Math.log10);
        const low = Math.floor(Math.min(...powers, 0));
        return [low, Math.max(Math.ceil(Math.max(...powers, low + 1)), low + 1)];
      }
      const lowest = Math.min(...values, 0); // a clock may be ahead, and an age negative
      return [lowest < 0 ? -roundUp(-lowest) : 0, roundUp(Math.max(...values, 1e-3))];
    },
    times() {
      return SECONDS.map((second) => ({
        x: this.across(second),
        text: second === 0 ? "now" : `${String(second).replace("-", "−")} s`,
        anchor: second === 0 ? "end" : second === -SPAN ? "start" : "middle",
      }));
    },
    levels() {
      const [low, high] = this.range;
      const count = this.logarithmic ? Math.min(high - low, 4) : 2;
      return Array.from({ length: count + 1 }, (_, i) => {
        const level = low + ((high - low) * i) / count;
        const text = this.logarithmic
          ? `1e${Math.round(level)}`.replace("-", "−")
          : String(Number(level.toPrecision(3)));
        return { y: this.down(level), text };
      });
    },
    /** Those that are 0 all the time are left out beside others that are not. */
    drawn() {
      const all = Object.entries(this.series);
      const busy = all.filter(([, points]) => points.some((point) => point[1] !== 0));
      return busy.length ? busy : all;
    },
    lines() {
      return this.drawn.map(([name, points], i) => ({
        name,
        colour: LINES[i % LINES.length],
        dash: i < LINES.length ? "none" : "4 3",
        last: this.number(points[points.length - 1][1]),
        path: points
          .filter((point) => !this.logarithmic || point[1] > 0)
          .map(([time, value], place) => {
            const level = this.logarithmic ? Math.log10(value) : value;
            const x = this.across(time - this.now).toFixed(1);
            return `${place ? "L" : "M"}${x},${this.down(level).toFixed(1)}`;
          })
          .join(""),
      }));
    },
    spoken() {
      const now = this.lines.map((line) => `${line.name} ${line.last} ${this.unit}`);
      return `${this.title} over the last minute; now ${now.join(", ") || "nothing"}`;
    },
  },
  methods: {
    /** New points: `series` is [[name, [[s, value], …]], …], and `now` is s of the same clock. */
    add(now, series, isFirst) {
      const all = isFirst ? {} : { ...this.series };
      for (const [name, points] of series) all[name] = [...(all[name] ?? []), ...points];
      for (const name of Object.keys(all)) {
        all[name] = all[name].filter((point) => point[0] > now - SPAN);
        if (!all[name].length) delete all[name];
      }
      this.now = now;
      this.series = all;
    },
    across(second) {
      return LEFT + ((second + SPAN) / SPAN) * (WIDTH - LEFT - RIGHT);
    },
    down(level) {
      const [low, high] = this.range;
      return TOP + ((high - level) / (high - low)) * (HEIGHT - TOP - BOTTOM);
    },
    number(value) {
      if (this.logarithmic) return value.toExponential(0).replace("-", "−");
      return String(Number(value.toPrecision(3))).replace("-", "−");
    },
  },
};
