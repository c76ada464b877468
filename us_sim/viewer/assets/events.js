/** A bus between the modules of the page: `events.on("probe-pose", handler)`. */

const target = new EventTarget();

export const events = {
  on(name, handler) {
    target.addEventListener(name, (event) => handler(event.detail));
  },
  tell(name, detail) {
    target.dispatchEvent(new CustomEvent(name, { detail }));
  },
};

/** The element of that id, once the page has it. */
export function element(id) {
  return new Promise((resolve) => {
    const look = () => {
      const found = document.getElementById(id);
      if (found) resolve(found);
      return Boolean(found);
    };
    if (look()) return;
    const observer = new MutationObserver(() => look() && observer.disconnect());
    observer.observe(document.documentElement, { childList: true, subtree: true });
  });
}
