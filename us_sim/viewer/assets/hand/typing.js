/** Whether a key belongs to what has the focus rather than to the page. */

const ENTRIES =
  "input:not([type=checkbox], [type=radio], [type=range]), textarea, select, [contenteditable], " +
  "[role=listbox], dialog, .q-dialog";
const SLIDERS = "input[type=range], [role=slider]";
/** Page up and down press and lift the probe also while one of its own sliders has the focus. */
const PAGED = ":is(input[type=range], [role=slider]):not(.us-quantity *)";
const PRESSED =
  "button, a, summary, input[type=checkbox], [role=button], [role=menuitem], [role=checkbox], " +
  "[role=switch], [role=tab]";
/** Among these the arrows go from one to the next. */
const NEIGHBOURS = "[role=tab], [role=menuitem], [role=radio], input[type=radio]";
const PRESSES = [" ", "Enter"];
const STEPS = ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", "Home", "End"];
const PAGES = ["PageUp", "PageDown"];

/** Whether the person types, or moves or presses a control, so that the key is not for the page. */
export function isTyping(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return true;
  // What was closed keeps the focus until the next picture is drawn.
  if (!(event.target.checkVisibility?.() ?? true)) return false;
  const isOn = (kinds) => Boolean(event.target.closest?.(kinds));
  if (isOn(ENTRIES)) return true;
  if (PRESSES.includes(event.key)) return isOn(`${PRESSED}, ${NEIGHBOURS}`);
  if (PAGES.includes(event.key)) return isOn(PAGED);
  return STEPS.includes(event.key) && isOn(`${NEIGHBOURS}, ${SLIDERS}`);
}

/**
 * What the pointer pressed gives the focus back, so that the space bar is the page's again. A click
 * of the keyboard has no detail: who goes there by Tab stays there.
 */
function giveBack(event) {
  if (!event.detail) return;
  const pressed = event.target.closest?.(PRESSED);
  if (pressed?.contains(document.activeElement)) document.activeElement.blur();
}
// First, so that what it opens does not give it the focus back; and after what it does itself.
addEventListener("click", giveBack, { capture: true });
addEventListener("click", giveBack);
