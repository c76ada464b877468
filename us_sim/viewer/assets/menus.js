/**
 * Quasar's menus, which stand in the body beside all parts of the page: each that is open becomes
 * a part that assistive technology lists, and what holds its options a group, as a listbox may have.
 */

function describe(portal) {
  const update = () => {
    const isOpen = portal.firstElementChild !== null; // one that is closed stays, empty
    portal.role = isOpen ? "region" : null;
    portal.ariaLabel = isOpen ? "Choices" : null;
    for (const held of portal.querySelectorAll(".q-virtual-scroll__content")) held.role = "group";
  };
  update();
  new MutationObserver(update).observe(portal, { childList: true, subtree: true });
}

new MutationObserver((changes) => {
  for (const node of changes.flatMap(({ addedNodes }) => [...addedNodes])) {
    if (node.id?.startsWith("q-portal--menu")) describe(node);
  }
}).observe(document.body, { childList: true });
