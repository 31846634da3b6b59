"""Pages about recorded missions: one HTML file that needs no network.

missions   the missions of a bag, step by step
health     when messages came, what nodes told about themselves, what went wrong
world      what a page draws, and tells, of a world
compare    missions or policies side by side
page       a page from its template, its data and Plotly, all in one file

`page.html` is the template; `common.js`, `mission.js`, `system.js` and `compare.js` draw what the data says;
`style.css` is how it looks. They know no formula of the world: whatever is computed is computed here.
"""
