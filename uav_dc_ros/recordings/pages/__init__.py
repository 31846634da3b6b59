"""Report pages: one HTML file without network access.

`page.html` is the template, `style.css` its style; `common.js`, `mission.js`, `vehicle.js`, `system.js` and
`compare.js` draw the data. They hold no formula: the Python modules compute all values.
"""
