/* What the page does in the browser itself. */

/* Words for the framework's notice, which is shown after 2 s without a connection. */
function labNameLostServer() {
  const lost = document.getElementById('popup');
  lost.role = 'alert';
  lost.children[0].textContent = 'The page has lost its server.';
  lost.children[1].textContent = 'Has noack lab ended? Start it again and open the address that it '
    + 'shows. The settings are in the address of this page, after the "?".';
}

/* Open or close the settings on a small screen. */
function labToggleSettings(event) {
  const button = event.currentTarget;
  button.ariaExpanded = button.parentElement.classList.toggle('lab-open');
}

/* Put the settings into the address; the browser limits how often this may be done. */
function labShowQuery(query) {
  clearTimeout(window.labQuery);
  window.labQuery = setTimeout(() => history.replaceState(null, '', query), 300);
}

/* Name the editor, which cannot be named from the server. */
function labNameEditor() {
  for (const text of document.querySelectorAll('.cm-content')) text.ariaLabel = 'scenario as TOML';
  for (const area of document.querySelectorAll('.cm-scroller')) area.tabIndex = 0;
}

/* Give each slider its value in words: the place of a logarithmic one is the value's logarithm.
   Set by the server, it would send the slider's old place, too, while it is dragged. */
function labSpeakSliders() {
  const panel = document.querySelector('.lab-settings');
  const speak = () => {
    for (const slider of panel.querySelectorAll('.q-slider')) {
      const text = slider.previousElementSibling.lastElementChild.textContent;
      if (slider.ariaValueText !== text) slider.ariaValueText = text;
    }
  };
  new MutationObserver(speak).observe(panel, {subtree: true, childList: true, characterData: true});
  speak();
}

/* Whether the browser has no graphics card to draw with. */
function labDrawsByProcessor() {
  const gl = document.createElement('canvas').getContext('webgl2');
  const info = gl?.getExtension('WEBGL_debug_renderer_info');
  const name = gl?.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  gl?.getExtension('WEBGL_lose_context')?.loseContext();
  return !name || /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}
