// The page: shows what the server says, lets a person watch, point and choose.

import { Player } from "./player.js";

const SIDE = 256;
const $ = (id) => document.getElementById(id);
const player = new Player($("image"), showFrame);
let state = { phase: "loading", options: [], reveals: [], decisions: [] };
let fetched = 0; // clips whose frames are here
let chosen = null; // the option selected
let point = null; // [row, column]
let seen = -1; // the latest frame that has been shown
let fetching = false;
let sending = false;
let focused = ""; // the outcome that has had the focus

// The server -----------------------------------------------------------------------------------------------------

async function ask(path, message) {
  const options = message === undefined ? {} : {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(message),
  };
  const response = await fetch(path, options);
  const content = await response.json();
  if (!response.ok && response.status !== 409) throw new Error(content.error);
  return response.ok ? content : (complain(content.error), ask("state"));
}

async function poll() {
  try {
    take(await ask("state"));
    if ($("error").dataset.lost) complain("");
  } catch {
    complain("The server does not respond. Is it still running?", true);
  }
  setTimeout(poll, ["loading", "moving"].includes(state.phase) ? 300 : 2000);
}

function take(next) {
  if (sending) return; // a response from before the choice
  const other = next.session !== state.session;
  state = { options: [], reveals: [], decisions: [], ...next };
  if (other) {
    player.clear();
    fetched = 0;
    seen = -1;
    deselect();
  }
  fetchClips();
  render();
}

async function fetchClips() {
  if (fetching) return;
  fetching = true;
  const session = state.session;
  try {
    while (session === state.session && fetched < state.reveals.length) {
      const number = fetched;
      if (!(await player.fetch(session, number, () => session === state.session))) break;
      fetched += 1;
      const { start, count } = state.reveals[number];
      if (count) player.play(Math.max(start - 1, 0), start + count - 1);
    }
  } catch {
    complain("The frames could not be fetched; trying again.", true);
  }
  fetching = false;
  render();
}

async function send() {
  if (!complete()) return;
  const message = { session: state.session, decision: state.decisions.length, choice: chosen.label, point };
  complain("");
  await post("choose", message, deselect);
}

async function post(path, message, done = () => {}) {
  sending = true;
  try {
    const next = await ask(path, message);
    sending = false;
    done();
    take(next);
  } catch (error) {
    complain(error.message || "The server does not respond.");
  }
  sending = false;
}

// What is seen -----------------------------------------------------------------------------------------------------

const ready = () => state.phase === "choosing" && fetched === state.reveals.length && player.last >= 0;
const complete = () => ready() && Boolean(chosen) && (!chosen.needs_point || (point !== null && !far()));

// The object that the point means: the nearest, within reach. Undefined where there is none.
function meant() {
  const distance = ([row, column]) => Math.hypot(row - point[0], column - point[1]);
  const near = (chosen.objects ?? []).filter((pixel) => distance(pixel) <= state.reach);
  return near.sort((a, b) => distance(a) - distance(b))[0];
}

// An environment need not say where its objects are: then no point is far from all of them.
const far = () => Boolean(chosen.objects) && !meant();

function render() {
  const { phase } = state;
  const over = ["ended", "finished", "broken"].includes(phase);
  $("where").textContent = state.task ? `${state.task} · episode ${state.episode} (${state.split})` : "";
  $("score").textContent = `${state.played ?? 0} of ${state.total ?? 0} played · ${state.successes ?? 0} solved`;
  $("goal").textContent = state.goal ?? "…";
  $("question").hidden = over;
  $("outcome").hidden = !over;
  if (over) showOutcome();
  const waits = phase === "loading" || phase === "moving" || (phase === "choosing" && !ready());
  $("veil").hidden = !waits;
  const words = { loading: "Setting the scene and the video up", moving: "The planner carries it out" };
  $("veil-text").textContent = `${words[phase] ?? "Fetching the clip"} … ${Math.round(state.for_s ?? 0)} s`;
  renderOptions();
  renderClips();
  showFrame();
}

function renderOptions() {
  const box = $("options");
  const key = JSON.stringify(state.options);
  if (box.dataset.key !== key) {
    box.dataset.key = key;
    box.replaceChildren(...state.options.map((option) => {
      const button = element("button", { type: "button", className: "option" });
      button.dataset.label = option.label;
      button.append(element("kbd", { textContent: option.label }), element("span", { textContent: option.action }));
      if (option.needs_point) button.append(element("em", { textContent: "point" }));
      button.addEventListener("click", () => select(option));
      return button;
    }));
  }
  for (const button of box.children) {
    button.disabled = !ready();
    button.setAttribute("aria-pressed", String(chosen?.label === button.dataset.label));
  }
  $("do").disabled = !complete();
  const pointing = ready() && chosen?.needs_point;
  $("frame").classList.toggle("pointing", Boolean(pointing));
  renderHint();
}

function renderHint() {
  const pointing = ready() && chosen?.needs_point;
  const watched = seen === player.last;
  $("hint").textContent = !ready() ? "" : !chosen ? (watched ? "Choose the next action." : "Watch the clip, then choose.")
    : pointing && !point ? "Click the object in the image (or move the point with the arrow keys)."
    : pointing ? `Point: row ${point[0]}, column ${point[1]}. ${pointed()}` : "";
}

function pointed() {
  if (far()) return "There is no object here: click on one.";
  return chosen.objects ? "The object meant has a dashed ring." : "";
}

function renderClips() {
  const known = state.reveals.slice(0, fetched);
  const key = JSON.stringify([state.session, known.map((clip) => clip.count), state.decisions.length]);
  if ($("clips").dataset.key === key) return;
  $("clips").dataset.key = key;
  const buttons = known.map((clip, number) => {
    const choice = state.decisions[number - 1];
    const text = choice ? `${number} · ${choice.choice}` : clip.title;
    const button = element("button", { type: "button", textContent: text, title: clip.title, disabled: !clip.count });
    button.style.flexGrow = Math.max(clip.count, 1);
    if (!number && state.video) button.classList.add("video");
    button.addEventListener("click", () => player.play(clip.start, clip.start + clip.count - 1));
    return button;
  });
  $("clips").replaceChildren(...buttons);
  $("history").replaceChildren(...state.decisions.map((decision, number) => {
    const clip = state.reveals[number + 1];
    const place = decision.point ? ` at row ${decision.point[0]}, column ${decision.point[1]}` : "";
    const moved = clip && !clip.count ? " (nothing moved)" : "";
    const item = element("li");
    const button = element("button", { type: "button", className: "link", disabled: !clip?.count });
    button.append(element("kbd", { textContent: decision.choice }), ` ${decision.action}${place}${moved}`);
    button.addEventListener("click", () => player.play(clip.start, clip.start + clip.count - 1));
    item.append(button);
    return item;
  }));
}

function showFrame() {
  const { at, last, playing } = player;
  seen = Math.max(seen, Math.min(at, last));
  $("seek").max = Math.max(last, 0);
  $("seek").value = at;
  $("seek").disabled = last < 0;
  $("place").textContent = last < 0 ? "" : `${at + 1} / ${last + 1}`;
  $("toggle").textContent = playing ? "Pause" : "Play";
  const inVideo = last >= 0 && at < (state.video ?? 0);
  $("frame").classList.toggle("video", inVideo);
  $("badge").textContent = last < 0 ? "" : inVideo ? "Conditioning video" : at === last ? "Present" : "Execution";
  renderHint();
  const marked = chosen?.needs_point && point && at === last;
  mark($("marker"), marked ? point : undefined);
  mark($("object"), marked ? meant() : undefined);
  $("marker").classList.toggle("far", Boolean(marked) && far());
}

// Shows a mark at a pixel, or hides it.
function mark(box, pixel) {
  box.hidden = !pixel;
  if (!pixel) return;
  box.style.top = `${((pixel[0] + 0.5) / SIDE) * 100}%`;
  box.style.left = `${((pixel[1] + 0.5) / SIDE) * 100}%`;
}

function showOutcome() {
  const titles = { success: "Solved", fail: "Failed", timeout: "Out of time", error: "The planner could not do that" };
  const { phase, status } = state;
  const box = $("outcome");
  box.className = `card ${phase === "ended" ? status : phase}`;
  const choices = `${state.decisions.length} ${state.decisions.length === 1 ? "choice" : "choices"}, ${state.steps} steps`;
  if (phase === "ended") {
    $("outcome-title").textContent = titles[status] ?? status;
    $("outcome-text").textContent = state.problem ? `${choices}. ${state.problem}` : `${choices}.`;
    $("next").innerHTML = state.played < state.total ? "Next episode <kbd>Enter</kbd>" : "Finish <kbd>Enter</kbd>";
  } else if (phase === "broken") {
    $("outcome-title").textContent = "The episode could not be played";
    $("outcome-text").textContent = state.error;
    $("next").textContent = "Try again";
  } else {
    $("outcome-title").textContent = "All episodes are played. Thank you!";
    $("outcome-text").textContent = (state.summary ?? [])
      .map((row) => `${row.task}: ${row.successes} of ${row.episodes} solved${row.human === null ? "" : ` (people in the paper: ${row.human} %)`}`).join("; ");
  }
  $("next").hidden = phase === "finished";
  const key = `${state.session} ${phase}`;
  if (focused !== key) $("outcome-title").focus();
  focused = key;
}

function complain(text, lost = false) {
  $("error").textContent = text;
  $("error").hidden = !text;
  if (lost) $("error").dataset.lost = "1";
  else delete $("error").dataset.lost;
}

function element(name, properties = {}) {
  return Object.assign(document.createElement(name), properties);
}

// What the person does ---------------------------------------------------------------------------------------------

function select(option) {
  if (!ready() || chosen?.label === option.label) return;
  chosen = option;
  point = null;
  if (option.needs_point) {
    showPresent();
    $("image").focus();
  }
  render();
}

const deselect = () => { chosen = point = null; render(); };

function showPresent() {
  player.pause();
  player.seek(player.last);
}

function setPoint(row, column) {
  const within = (value) => Math.max(0, Math.min(SIDE - 1, Math.floor(value)));
  point = [within(row), within(column)];
  render();
}

function toggle() {
  if (player.playing) player.pause();
  else if (player.at < player.last) player.play(player.at, player.last);
  else replay();
}

function replay() {
  const clip = state.reveals.findLast((one) => one.start <= player.at && one.count);
  if (clip) player.play(clip.start, clip.start + clip.count - 1);
}

$("image").addEventListener("click", (event) => {
  if (!ready() || !chosen?.needs_point) return;
  if (player.at !== player.last) return showPresent(); // what was clicked is not what is there now
  const box = $("image").getBoundingClientRect();
  setPoint(((event.clientY - box.top) / box.height) * SIDE, ((event.clientX - box.left) / box.width) * SIDE);
});
// Set with the mouse, the slider and the speed box give the keys back to the page.
$("seek").addEventListener("pointerup", () => $("seek").blur());
$("speed").addEventListener("change", () => { if (!$("speed").matches(":focus-visible")) $("speed").blur(); });
$("seek").addEventListener("input", () => {
  const at = Number($("seek").value); // read before pausing, which sets the slider to the frame shown
  player.pause();
  player.seek(at);
});
$("toggle").addEventListener("click", toggle);
$("replay").addEventListener("click", replay);
$("present").addEventListener("click", showPresent);
$("speed").addEventListener("change", () => { player.speed = Number($("speed").value); });
$("do").addEventListener("click", send);
$("next").addEventListener("click", () => { complain(""); post("next", {}); });

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  // The slider and the speed box keep the keys that set them; all others are the page's wherever the focus is.
  const own = { INPUT: /^Arrow/, SELECT: /^(Arrow|Enter$| $)/ }[event.target.tagName];
  if (own?.test(event.key)) return;
  const onOption = event.target.classList?.contains("option");
  const onButton = event.target.tagName === "BUTTON" && !onOption;
  const arrows = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
  const option = state.options.find((one) => one.label === event.key.toLowerCase());
  if (arrows[event.key]) {
    const [down, right] = arrows[event.key];
    const far = event.shiftKey ? 10 : 1;
    if (ready() && chosen?.needs_point && player.at === player.last) {
      const [row, column] = point ?? [SIDE / 2, SIDE / 2];
      setPoint(row + down * far, column + right * far);
    } else if (right) {
      player.pause();
      player.seek(player.at + right * far);
    } else return;
  } else if (event.key === "Enter" && !onButton) {
    if (["ended", "broken"].includes(state.phase)) $("next").click();
    else if (onOption && event.target.dataset.label !== chosen?.label) return;
    else send();
  } else if (event.key === " " && !onButton) toggle();
  else if (event.key === "Escape") deselect();
  else if (option && !event.repeat) select(option);
  else return;
  event.preventDefault();
});

poll();
