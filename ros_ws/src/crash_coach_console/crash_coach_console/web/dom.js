// Small helpers for the page's elements.

/**
 * An element with attributes and children; "text" sets its text, "class" its classes.
 * @param {string} tag
 * @param {Record<string, unknown>} [attributes]
 * @param {(Node | string)[]} [children]
 * @returns {HTMLElement}
 */
export function make(tag, attributes = {}, children = []) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "text") element.textContent = String(value);
    else if (value !== false && value !== null && value !== undefined) {
      element.setAttribute(name, value === true ? "" : String(value));
    }
  }
  element.append(...children);
  return element;
}

/** Sets an element's text only where it differs: readers of a screen are told of every change. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** The element that a selector names; an error where there is none. */
export function find(root, selector) {
  const element = root.querySelector(selector);
  if (element === null) throw new Error(`no ${selector}`);
  return element;
}

/** "robot_1" -> "1", "rover_east" -> "RE": what fits into a disc. */
export function shortName(name) {
  const digits = /(\d+)$/.exec(name);
  if (digits) return digits[1];
  return name.split("_").map((part) => part.charAt(0).toUpperCase()).join("").slice(0, 2);
}
