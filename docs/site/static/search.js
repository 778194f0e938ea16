/*
 * Search of the site. Sphinx lists the pages that contain all words of a query. Here the best
 * section of each page is listed, ranked by how many of the words it contains, how rare these are,
 * and whether its heading, or a term of the glossary that leads to it, consists of them.
 */
"use strict";

const siteSearch = (() => {
  const NAME_WEIGHT = 1; // of words of a heading or term, beside those of the text
  const SATURATION = 1.2; // of BM25: repeated words add ever less
  const LENGTH_SHARE = 0.6; // of BM25: long sections need more repetitions
  const PAGE_SHARE = 0.3; // a page that is about the words is preferred to one that mentions them

  const stemmer = new Stemmer();
  const stems = new Map();

  const stem = (word) => {
    if (!stems.has(word)) {
      const american = word.replace(/is(e[drs]?|ing|ations?)$/, "iz$1").replace(/our/, "or");
      stems.set(word, stemmer.stemWord(american));
    }
    return stems.get(word);
  };

  const split = (text) =>
    (text.toLowerCase().match(/[\p{L}\p{N}_]+/gu) || [])
      .filter((word) => !stopwords.has(word) && (word.length > 1 || word === "c"))
      .map(stem);

  const count = (words) => {
    const counts = new Map();
    words.forEach((word) => counts.set(word, (counts.get(word) || 0) + 1));
    return counts;
  };

  const read = (sections) => {
    const units = sections.map(([page, anchor, title, heading, names, text, weight]) => {
      const words = split(text);
      const all = [...names, heading].map((name) => new Set(split(name)));
      const counts = count([...words, ...all.flatMap((name) => [...name])]);
      return { page, anchor, title, heading, names: all, counts, weight, length: words.length + 20 };
    });
    const frequencies = count(units.flatMap((unit) => [...unit.counts.keys()]));
    const mean = units.reduce((sum, unit) => sum + unit.length, 0) / units.length;
    return { units, frequencies, mean };
  };

  const rank = (query, { units, frequencies, mean }) => {
    const words = [...new Set(split(query))];
    const weight = (word) => Math.log(1 + units.length / (1 + (frequencies.get(word) || 0)));
    const total = (some) => some.reduce((sum, word) => sum + weight(word), 0);
    const scored = units.map((unit) => {
      const text = words.reduce((sum, word) => {
        const times = unit.counts.get(word) || 0;
        const length = 1 - LENGTH_SHARE + (LENGTH_SHARE * unit.length) / mean;
        return sum + (weight(word) * times) / (times + SATURATION * length);
      }, 0);
      const name = Math.max(
        ...unit.names.map((own) => {
          const common = words.filter((word) => own.has(word));
          return (total(common) * common.length) / (own.size || 1);
        }),
      );
      const found = words.filter((word) => unit.counts.has(word));
      const share = total(found) / (total(words) || 1);
      return { ...unit, score: unit.weight * share * (text + NAME_WEIGHT * name) };
    });
    const pages = new Map();
    for (const unit of scored.filter((unit) => unit.score > 0)) {
      const page = pages.get(unit.page) || { best: unit, sum: 0 };
      page.sum += unit.score;
      if (unit.score > page.best.score) page.best = unit;
      pages.set(unit.page, page);
    }
    return [...pages.values()]
      .map(({ best, sum }) => ({ ...best, score: best.score + PAGE_SHARE * Math.sqrt(sum) }))
      .sort((a, b) => b.score - a.score);
  };

  return { read, rank };
})();

if (typeof Search !== "undefined") {
  const index = siteSearch.read(siteSections);
  const MIN_SHARE = 0.2; // of the best result: what contains less of the words is left out

  Search._performSearch = (query) => {
    const { docnames, filenames } = Search._index;
    document.getElementById("search-progress")?.replaceChildren();
    const pages = siteSearch.rank(query, index);
    const results = pages
      .filter(({ score }) => score > MIN_SHARE * pages[0].score)
      .map(({ page, anchor, title, heading, score }) => [
        page, heading === title ? title : `${title} > ${heading}`, anchor && "#" + anchor,
        null, score, filenames[docnames.indexOf(page)], SearchResultKind.text,
      ]);
    const name = query.trim().toLowerCase();
    const isName = (result) => result[1].toLowerCase().endsWith(name);
    const objects = /^\w+[._]\w/.test(name) ? Search.performObjectSearch(name, new Set([name])) : [];
    return [...objects.filter(isName), ...results].reverse(); // the best result is the last one
  };
}
