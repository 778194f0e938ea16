/* Print the pages that the search of the site lists for each line of standard input, as JSON. */
"use strict";
const fs = require("fs");
const vm = require("vm");

const context = vm.createContext({});
context.window = context;
const scripts = ["language_data.js", "sections.js", "search.js"];
for (const name of scripts) vm.runInContext(fs.readFileSync(`${process.argv[2]}/${name}`, "utf8"), context);
const index = vm.runInContext("siteSearch.read(siteSections)", context);
const { rank } = vm.runInContext("siteSearch", context);
const queries = fs.readFileSync(0, "utf8").trim().split("\n");
const results = queries.map((query) => rank(query, index).map((each) => `${each.page}#${each.anchor}`));
console.log(JSON.stringify(results));
