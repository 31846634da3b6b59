"""Report pages: one HTML file without network access. Python computes all values; the scripts draw them."""
