// Rows: a list of elements, one for each item, which change in place. A button that is replaced while it is pressed gets
// no click, and one that is replaced while it has the focus loses it.

/** @typedef {{node: HTMLElement, show: (item: any) => void}} Row */

export class Rows {
  /**
   * @param {HTMLElement} root the list
   * @param {() => Row} make a new row, still empty
   */
  constructor(root, make) {
    this.root = root;
    this.make = make;
    this.rows = new Map(); // by id of the item
  }

  /** @param {{id: string}[]} items all that the list shows, in their order */
  show(items) {
    const ids = new Set(items.map((item) => item.id));
    for (const [id, { node }] of this.rows) {
      if (ids.has(id)) continue;
      node.remove();
      this.rows.delete(id);
    }
    let next = this.root.firstElementChild;
    for (const item of items) {
      if (!this.rows.has(item.id)) this.rows.set(item.id, this.make());
      const { node, show } = this.rows.get(item.id);
      show(item);
      if (node === next) next = next.nextElementSibling;
      else this.root.insertBefore(node, next);
    }
  }
}
