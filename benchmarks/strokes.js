// Notes the time from a move of the mouse to the painted curve that follows it, ms, in STROKES.
window.STROKES = [];
let movedAt = 0;
addEventListener("pointermove", event => { movedAt = event.timeStamp; }, true);
const notePainted = at => requestAnimationFrame(() => {
  const painted = new MessageChannel();  // a message follows when the frame has been painted
  painted.port1.onmessage = () => STROKES.push(performance.now() - at);
  painted.port2.postMessage(0);
});
const show = LabFigure.prototype.show;
LabFigure.prototype.show = function (content) {
  show.call(this, content);
  if (movedAt) notePainted(movedAt);
  movedAt = 0;
};
0
