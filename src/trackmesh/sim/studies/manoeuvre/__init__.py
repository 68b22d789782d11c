"""The study of the manoeuvre filter: what it gains over the plain filter that it contains, and where it does not."""
