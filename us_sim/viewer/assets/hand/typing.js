/** Whether keys belong to what has the focus rather than to the page. */

const ENTRIES =
  "input, textarea, select, [contenteditable], [role=slider], [role=listbox], [role=tab], dialog, " +
  ".q-dialog";
const PRESSED = "button, a, summary, [role=button], [role=menuitem], [role=checkbox], [role=switch]";

/** Whether the person types, or moves a control, so that no key is for the page. */
export function isTyping(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return true;
  return Boolean(event.target.closest?.(ENTRIES));
}

/** Likewise for the space bar and Enter, which press the button that has the focus. */
export function isPressing(event) {
  return isTyping(event) || Boolean(event.target.closest?.(PRESSED));
}
