// The search: finds words as typed, with their dashes and dots. It replaces the theme's worker and has its messages:
// 0 brings the sections, 1 says that they are read, 2 is a query, 3 brings the results.
// A word matches where a word of the text begins with it. Every word has to be in a section or in its title.
const SETUP = 0, READY = 1, QUERY = 2, RESULT = 3;
const LIMIT = 60; // sections shown
const SHOWN = 320; // characters of a section's text around its first match
let sections = [];

const plain = (html) =>
  html
    .replace(/<\/?(a|code|em|span|strong)\b[^>]*>/g, "")
    .replace(/<[^>]*>/g, " ")
    .replace(/&lt;/g, "<")
    .replace(/&gt;/g, ">")
    .replace(/&quot;/g, '"')
    .replace(/&#0?39;/g, "'")
    .replace(/&amp;/g, "&")
    .replace(/[\s\u00a0]+/g, " ")
    .trim();
const html = (text) => text.replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
const escaped = (text) => text.replace(/[.*+?^${}()|[\]\\]/g, "\\$&");

function setup(docs) {
  const pages = new Map(docs.filter((doc) => !doc.location.includes("#")).map((doc) => [doc.location, doc]));
  sections = docs.map((doc) => {
    const title = plain(doc.title), text = plain(doc.text), page = pages.get(doc.location.split("#")[0]);
    const parent = page && page !== doc ? page : undefined;
    const path = parent ? plain(parent.title).toLowerCase() : "";
    return { doc, parent, title, text, path, lowerTitle: title.toLowerCase(), lowerText: text.toLowerCase() };
  });
}

// Endings of a word that is not found as it was typed.
function stem(word) {
  const short = word.replace(/(ies|ing|es|ed|s)$/, "");
  return short.length >= 4 ? short : word;
}

// A pattern for a word: at the beginning of a word of the text, or anywhere for one that begins with a sign.
const pattern = (word) => new RegExp((/^[\p{L}\p{N}_]/u.test(word) ? "(?<![\\p{L}\\p{N}])" : "") + escaped(word), "giu");

const count = (text, expression, most = 20) => {
  let found = 0;
  expression.lastIndex = 0;
  while (found < most && expression.exec(text)) found++;
  return found;
};

// How well a section matches one word. 0: not at all.
function score(section, word, expression) {
  const { lowerTitle, lowerText, path } = section;
  let points = 0;
  if (lowerTitle.includes(word) && count(lowerTitle, expression, 1)) {
    const share = word.length / lowerTitle.length;
    points += 12 + 24 * share + (lowerTitle === word ? 20 : 0);
  }
  if (lowerText.includes(word)) points += 2 * Math.log2(1 + count(lowerText, expression));
  if (points > 0 && path.includes(word)) points += 4;
  return points;
}

function find(words) {
  const expressions = words.map(pattern);
  const found = [];
  for (const section of sections) {
    let total = 0, missing = false;
    words.forEach((word, i) => {
      let points = score(section, word, expressions[i]);
      if (!points && section.path.includes(word) && words.length > 1) points = 1;
      missing ||= !points;
      total += points;
    });
    if (missing) continue;
    const phrase = words.join(" ");
    if (words.length > 1 && `${section.lowerTitle} ${section.lowerText}`.includes(phrase)) total *= 4;
    found.push({ section, score: total * (section.doc.boost ?? 1) * (section.parent ? 1 : 1.3) });
  }
  return found;
}

function marked(text, expressions) {
  const places = [];
  for (const expression of expressions) {
    expression.lastIndex = 0;
    for (let match; (match = expression.exec(text)) && places.length < 50; ) places.push([match.index, match.index + match[0].length]);
  }
  places.sort((a, b) => a[0] - b[0]);
  let result = "", end = 0;
  for (const [from, to] of places) {
    if (from < end) continue;
    result += html(text.slice(end, from)) + "<mark>" + html(text.slice(from, to)) + "</mark>";
    end = to;
  }
  return result + html(text.slice(end));
}

function excerpt(text, expressions) {
  const places = expressions.map((expression) => ((expression.lastIndex = 0), expression.exec(text)?.index ?? -1));
  const first = Math.min(...places.filter((place) => place >= 0), Infinity);
  if (first === Infinity) return "";
  const from = first < 80 ? 0 : text.indexOf(" ", first - 60) + 1;
  return (from ? "… " : "") + marked(text.slice(from, from + SHOWN), expressions) + (from + SHOWN < text.length ? " …" : "");
}

function query(text) {
  let words = [...new Set(text.replace(/["\u00a0]/g, " ").toLowerCase().split(/\s+/).filter(Boolean))];
  if (!words.length) return { items: [] };
  let found = find(words);
  if (!found.length) found = find((words = words.map(stem)));
  if (!found.length && words.some((word) => /[-._/=]/.test(word))) {
    words = words.flatMap((word) => word.split(/[-._/=]+/)).filter(Boolean);
    found = find(words);
  }
  const expressions = words.map(pattern);
  const terms = Object.fromEntries(words.map((word) => [word, true]));
  const items = new Map();
  for (const { section, score } of found.sort((a, b) => b.score - a.score).slice(0, LIMIT)) {
    const { doc, parent, title, text } = section;
    const page = doc.location.split("#")[0];
    if (!items.has(page)) items.set(page, []);
    items.get(page).push({ ...doc, parent, title: marked(title, expressions), text: excerpt(text, expressions), score, terms });
  }
  // The theme shows a page above its sections.
  for (const [page, list] of items) {
    if (list.some((item) => item.location === page)) continue;
    const section = sections.find((other) => other.doc.location === page);
    if (section) list.push({ ...section.doc, title: marked(section.title, expressions), text: "", score: 0, terms: {} });
  }
  return { items: [...items.values()] };
}

addEventListener("message", ({ data }) => {
  if (data.type === SETUP) {
    setup(data.data.docs);
    postMessage({ type: READY });
  } else if (data.type === QUERY) {
    postMessage({ type: RESULT, data: query(data.data) });
  }
});
