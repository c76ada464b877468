/**
 * Quasar's menus, which stand in the body beside all parts of the page: each becomes a part that
 * assistive technology lists, and what holds its options a group, as a listbox may have.
 */

function describe(portal) {
  portal.setAttribute("role", "region");
  portal.setAttribute("aria-label", "Choices");
  const group = () => {
    for (const held of portal.querySelectorAll(".q-virtual-scroll__content")) held.role = "group";
  };
  group();
  new MutationObserver(group).observe(portal, { childList: true, subtree: true });
}

new MutationObserver((changes) => {
  for (const node of changes.flatMap(({ addedNodes }) => [...addedNodes])) {
    if (node.id?.startsWith("q-portal--menu")) describe(node);
  }
}).observe(document.body, { childList: true });
