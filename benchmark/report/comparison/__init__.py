"""A comparison of runs for people: tables, sentences, page."""
