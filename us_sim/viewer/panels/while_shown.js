/** Tells whether a person can see it: in an open drawer, a chosen tab, a page that is in front. */
export default {
  template: "<div><slot></slot></div>",
  emits: ["shown"],
  data: () => ({ inView: false, told: false }),
  mounted() {
    // A closed drawer lies beside the window, and what only touches its edge "intersects", too;
    // a dialog has no size yet when it begins to open.
    this.observer = new IntersectionObserver(
      (entries) => {
        const { isIntersecting, intersectionRect, boundingClientRect } = entries.at(-1);
        const isBeside = boundingClientRect.width > 0 && intersectionRect.width === 0;
        this.inView = isIntersecting && !isBeside;
        this.tell();
      },
      { threshold: [0, 1e-6] },
    );
    this.observer.observe(this.$el);
    document.addEventListener("visibilitychange", this.tell);
  },
  beforeUnmount() {
    this.observer.disconnect();
    document.removeEventListener("visibilitychange", this.tell);
    this.inView = false;
    this.tell();
  },
  methods: {
    tell() {
      const isShown = this.inView && !document.hidden;
      if (isShown === this.told) return;
      this.told = isShown;
      this.$emit("shown", isShown);
    },
    /** Tell once more: the server may have taken the page for gone meanwhile. */
    again() {
      this.$emit("shown", this.told);
    },
  },
};
