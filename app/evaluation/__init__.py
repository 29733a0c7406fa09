"""Is selecting worth it? Every strategy on the same frames, by the same protocol."""
