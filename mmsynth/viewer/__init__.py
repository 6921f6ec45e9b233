"""A field in the browser (viser): looked at, asked, and flown through."""
