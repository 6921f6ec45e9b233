"""How good a field and its conversions are."""
