"""Electromagnetic induction: where a buried conductor lies and what it is, from the field it sends back."""
