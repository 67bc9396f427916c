// Ranks recipes first in the search of the site, and reference pages and manuals last.
var Scorer = {
  score: ([page, , , , score]) => {
    if (page.startsWith("docs/howto/")) return score + 20;
    return /^docs\/(reference\/|man\/|json$)/.test(page) ? score - 20 : score;
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
