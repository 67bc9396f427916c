// Ranks pages whose title has a word of the search first, and recipes before other pages with the
// word in a heading, then recipes and other pages that only mention it; references come last.
var Scorer = {
  score: ([page, title, , , score]) => {
    const words = (new URLSearchParams(location.search).get("q") ?? "").toLowerCase().split(/\W+/);
    const titled = words.some((word) => word && title.toLowerCase().includes(word)) ? 5 : 0;
    if (page.startsWith("docs/howto/")) return score + titled + (score >= Scorer.title ? 20 : 5);
    return (/^docs\/(reference\/|man\/|json$)/.test(page) ? score - 20 : score) + titled;
  },
  // The values of Sphinx.
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
