"use strict";
// Follows the server: asks for the version of what the page shows, and fetches the page again where there is another one.
// What the reader has done stays: zoom, filter, sorting, open parts, scrolling, and notes that are being written.
const live = (() => {
  const status = document.getElementById("following");
  const every = 1000 * Number(document.body.dataset.refresh);
  const here = new URL("version" + location.search, location.href);
  let moving = false; // what loses the focus now gets it back
  let version = document.body.dataset.version;

  const say = (text, bad = false) => {
    if (status.textContent !== text) status.textContent = text;
    status.classList.toggle("leaves", bad);
  };
  const name = (element) => element.getAttribute("aria-label");
  const each = (root, selector, act) => root.querySelectorAll(selector).forEach(act);
  const matching = (root, selector, value, of) => [...root.querySelectorAll(selector)].find((element) => of(element) === value);
  const written = (area) => area.value !== area.defaultValue || area === document.activeElement;

  function swap(next) {
    const [before, after] = [document.getElementById("content"), next.getElementById("content")];
    const active = document.activeElement;
    const caret = active && active.tagName === "TEXTAREA" ? [active.selectionStart, active.selectionEnd] : null;
    const frames = [...before.querySelectorAll(".scroll")].map((f) => [name(f), f.scrollTop, f.scrollLeft]);
    const sorted = [...before.querySelectorAll("th[aria-sort]")].map((th) => [name(th.closest(".scroll")), th.cellIndex, th.getAttribute("aria-sort") === "descending"]);
    const open = [...before.querySelectorAll("details")].map((d) => [d.firstElementChild.textContent.split(":")[0], d.open]);
    const ticked = new Set([...before.querySelectorAll("input[name=e]:checked")].map((box) => box.value));
    moving = true;
    // Charts keep their state by staying the same elements; so do a film that is playing and a note half written.
    each(before, "figure[data-figure]", (old) => {
      matching(after, "figure[data-figure]", old.dataset.figure, (f) => f.dataset.figure)?.querySelector(".charts").replaceWith(old.querySelector(".charts"));
    });
    each(before, "video", (old) => matching(after, "video", old.src, (v) => new URL(v.getAttribute("src"), location.href).href)?.replaceWith(old));
    each(before, "textarea", (old) => { if (written(old)) matching(after, "textarea", old.dataset.note, (a) => a.dataset.note)?.replaceWith(old); });
    before.replaceWith(document.adoptNode(after));
    moving = false;
    const [data, newData] = [document.getElementById("data"), next.getElementById("data")];
    if (data) data.textContent = newData.textContent;
    document.querySelector("h1").replaceWith(document.adoptNode(next.querySelector("h1")));
    if (next.getElementById("written")) document.getElementById("written").textContent = next.getElementById("written").textContent;
    if (typeof prepare === "function") prepare();
    const now = document.getElementById("content");
    sorted.forEach(([label, column, down]) => { const frame = matching(now, ".scroll", label, name); if (frame) sortTable(frame.querySelector("table"), column, down); });
    frames.forEach(([label, top, left]) => { const frame = matching(now, ".scroll", label, name); if (frame) [frame.scrollTop, frame.scrollLeft] = [top, left]; });
    open.forEach(([label, was]) => { const part = matching(now, "details", label, (d) => d.firstElementChild.textContent.split(":")[0]); if (part) part.open = was; });
    each(now, "input[name=e]", (box) => { box.checked = ticked.has(box.value); });
    if (active && active.isConnected && active !== document.activeElement) {
      active.focus({ preventScroll: true });
      if (caret) active.setSelectionRange(...caret);
    }
    watchNotes();
  }

  async function look() {
    try {
      const answer = await fetch(here);
      if (!answer.ok) throw new Error(await answer.text());
      const newest = (await answer.json()).version;
      if (newest !== version) {
        const page = await fetch(location.href);
        if (!page.ok) throw new Error(await page.text());
        const next = new DOMParser().parseFromString(await page.text(), "text/html");
        version = next.body.dataset.version;
        swap(next);
      }
      say(`Followed live; looked at ${new Date().toLocaleTimeString()}.`);
    } catch (error) {
      say(error instanceof TypeError ? "The dashboard does not answer; trying again." : String(error.message).trim(), true);
    }
  }

  async function save(area) {
    const text = area.value;
    try {
      const answer = await fetch(new URL(`${area.dataset.note}/note`, location.href), { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ text }) });
      if (!answer.ok) throw new Error(await answer.text());
      area.defaultValue = text;
      area.setCustomValidity("");
      say("The note is saved.");
    } catch (error) {
      area.setCustomValidity("not saved");
      say(`The note is not saved: ${String(error.message).trim()}`, true);
    }
  }
  function watchNotes() {
    each(document, "textarea[data-note]", (area) => {
      if (area.dataset.watched) return;
      area.dataset.watched = "1";
      // Not "change": that also comes when a field is moved, and not again afterwards.
      area.addEventListener("blur", () => { if (!moving && area.value !== area.defaultValue) save(area); });
    });
  }

  watchNotes();
  say("Followed live.");
  // One look after the other, and none while nobody sees the page.
  (async () => {
    for (;;) {
      await new Promise((done) => setTimeout(done, every));
      if (document.visibilityState === "visible") await look();
    }
  })();
  return { look };
})();
