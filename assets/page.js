"use strict";
// The viewer of a page of glstar: one frame, with marks over it, that can be zoomed and moved.
(function () {
  const frames = JSON.parse(document.getElementById("data").textContent).frames;
  const stage = document.getElementById("stage");
  if (!stage || !frames.length) return;
  const SVG = "http://www.w3.org/2000/svg";
  const LARGEST_ZOOM = 40;
  const thumbnails = [...document.querySelectorAll(".thumbnails button")];
  const hidden = new Set();
  const pointers = new Map();
  let shown = 0;
  let view = [0, 0, 1, 1]; // left, top, width, height of what is seen, px of the frame

  function add(parent, name, attributes, text) {
    const element = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text !== undefined) element.textContent = text;
    parent.appendChild(element);
    return element;
  }

  function path(points) {
    if (points.length === 6) { // a parabola through start, middle and end
      const [x0, y0, x1, y1, x2, y2] = points;
      return "M" + x0 + " " + y0 + "Q" + (2 * x1 - (x0 + x2) / 2) + " " + (2 * y1 - (y0 + y2) / 2) + " " + x2 + " " + y2;
    }
    let d = "";
    for (let k = 0; k + 1 < points.length; k += 2) d += (k ? "L" : "M") + points[k] + " " + points[k + 1];
    return d;
  }

  function show(k) {
    shown = Math.min(Math.max(k, 0), frames.length - 1);
    const frame = frames[shown];
    stage.replaceChildren();
    const image = thumbnails[shown] && thumbnails[shown].querySelector("img");
    if (image) {
      const place = { href: image.src, x: 0, y: 0, width: frame.w, height: frame.h, preserveAspectRatio: "none" };
      add(stage, "image", place);
    }
    // Positions count from the centre of the top left pixel.
    const marks = add(stage, "g", { transform: "translate(0.5 0.5)" });
    const layers = {};
    for (const kind of ["trails", "circles", "answers", "wrong", "names"]) layers[kind] = add(marks, "g", { class: kind });
    for (const [name, detectable, middle, radius, trails] of frame.marks) {
      for (const trail of trails) add(layers.trails, "path", { d: path(trail), class: detectable ? "" : "faint" });
      if (middle && detectable) add(layers.circles, "circle", { cx: middle[0], cy: middle[1], r: radius });
      if (middle && name) add(layers.names, "text", { x: middle[0], y: middle[1], "data-beside": radius }, name);
    }
    for (const [kind, d] of frame.answer || []) add(layers[kind], "path", { d: d });
    document.getElementById("caption").textContent = "frame " + frame.frame + ", " + frame.file + ", " + frame.utc +
      "; " + frame.facts;
    for (const one of document.querySelectorAll(".chosen")) one.classList.remove("chosen");
    for (const one of document.querySelectorAll('[data-k="' + shown + '"]')) one.classList.add("chosen");
    if (thumbnails[shown]) {
      const box = thumbnails[shown].parentElement;
      const top = thumbnails[shown].offsetTop - box.offsetTop;
      if (top < box.scrollTop || top > box.scrollTop + box.clientHeight - 60) box.scrollTop = top - 60;
    }
    hide();
    whole();
  }

  function hide() {
    for (const kind of ["trails", "circles", "answers", "wrong", "names"]) {
      const of = kind === "wrong" ? "answers" : kind;
      for (const group of stage.querySelectorAll("g." + kind)) group.style.display = hidden.has(of) ? "none" : "";
    }
  }

  function whole() {
    look([0, 0, frames[shown].w, frames[shown].h]);
  }

  function look(wanted) {
    const { w, h } = frames[shown];
    const width = Math.min(Math.max(wanted[2], w / LARGEST_ZOOM), w);
    const height = width * h / w;
    const left = Math.min(Math.max(wanted[0], 0), w - width);
    const top = Math.min(Math.max(wanted[1], 0), h - height);
    view = [left, top, width, height];
    stage.setAttribute("viewBox", view.join(" "));
    stage.classList.toggle("close", w / width > 3);
    const scale = width / (stage.clientWidth || w); // px of the frame for one of the screen
    for (const label of stage.querySelectorAll("text")) {
      label.setAttribute("font-size", 12 * scale);
      label.setAttribute("stroke-width", 2 * scale);
      label.setAttribute("dx", Number(label.dataset.beside) + 3 * scale);
      label.setAttribute("dy", 4 * scale);
    }
  }

  function zoom(factor, x, y) {
    const width = Math.min(Math.max(view[2] / factor, frames[shown].w / LARGEST_ZOOM), frames[shown].w);
    const ratio = width / view[2];
    look([x - (x - view[0]) * ratio, y - (y - view[1]) * ratio, width]);
  }

  function place(clientX, clientY) {
    const matrix = stage.getScreenCTM().inverse();
    const point = new DOMPoint(clientX, clientY).matrixTransform(matrix);
    return [point.x, point.y];
  }

  function middle() {
    return [view[0] + view[2] / 2, view[1] + view[3] / 2];
  }

  stage.addEventListener("wheel", function (event) {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...place(event.clientX, event.clientY));
  }, { passive: false });
  stage.addEventListener("dblclick", whole);
  stage.addEventListener("pointerdown", function (event) {
    stage.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    stage.classList.add("pulled");
  });
  stage.addEventListener("pointermove", function (event) {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const other = [...pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at)[0];
    const [fromX, fromY] = place(...before);
    const [toX, toY] = place(...now);
    pointers.set(event.pointerId, now);
    if (other) { // two fingers
      const apart = Math.hypot(before[0] - other[0], before[1] - other[1]);
      if (apart > 0) zoom(Math.hypot(now[0] - other[0], now[1] - other[1]) / apart, ...place(...other));
    } else {
      look([view[0] + fromX - toX, view[1] + fromY - toY, view[2]]);
    }
  });
  for (const kind of ["pointerup", "pointercancel"]) {
    stage.addEventListener(kind, function (event) {
      pointers.delete(event.pointerId);
      stage.classList.toggle("pulled", pointers.size > 0);
    });
  }
  document.getElementById("before").addEventListener("click", () => show(shown - 1));
  document.getElementById("after").addEventListener("click", () => show(shown + 1));
  document.getElementById("closer").addEventListener("click", () => zoom(1.5, ...middle()));
  document.getElementById("farther").addEventListener("click", () => zoom(1 / 1.5, ...middle()));
  document.getElementById("whole").addEventListener("click", whole);
  window.addEventListener("resize", () => look(view));
  document.addEventListener("keydown", function (event) {
    if (event.target.tagName === "INPUT" || event.ctrlKey || event.altKey || event.metaKey) return;
    if (event.key === "ArrowLeft") show(shown - 1);
    if (event.key === "ArrowRight") show(shown + 1);
  });
  for (const box of document.querySelectorAll("[data-layer]")) {
    box.addEventListener("change", function () {
      if (box.checked) hidden.delete(box.dataset.layer); else hidden.add(box.dataset.layer);
      hide();
    });
  }
  for (const one of document.querySelectorAll("[data-k]")) {
    one.addEventListener("click", function () {
      show(Number(one.dataset.k));
      if (one.tagName !== "BUTTON") stage.scrollIntoView({ block: "nearest" });
    });
  }
  show(0);
  // The hash of an address, #3, opens a frame.
  const linked = Number(location.hash.slice(1));
  if (linked) show(frames.findIndex((frame) => frame.frame === linked));
})();
