/**
 * Lets one finger scroll the page over a view: it moves the scene up and down only after the view was tapped, until it is left.
 * Two fingers always move the scene.
 */

/**
 * @param {HTMLElement} element  the view, whose class `entered` its style reads
 * @param {AbortSignal} signal  ends it
 * @returns {() => void}  enters the view
 */
export function enterable(element, signal) {
  const enter = (/** @type {boolean} */ on) => element.classList.toggle("entered", on);
  const hint = document.createElement("p");
  hint.className = "enter";
  hint.textContent = "Tap to move the scene with one finger";
  const leave = document.createElement("button");
  leave.type = "button";
  leave.className = "leave small";
  leave.textContent = "Done";
  leave.addEventListener("click", () => {
    enter(false);
    element.blur();
  });
  // The view would take the pointer for a drag of the scene.
  leave.addEventListener("pointerdown", (event) => event.stopPropagation());
  element.append(hint, leave);
  element.addEventListener("touchmove", (event) => {
    if (event.touches.length > 1) event.preventDefault();
  }, { signal, passive: false });
  document.addEventListener("pointerdown", (event) => {
    if (!element.contains(/** @type {Node} */ (event.target))) enter(false);
  }, { signal });
  return () => enter(true);
}
