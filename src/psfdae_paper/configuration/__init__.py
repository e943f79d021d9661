"""Typed configuration: Hydra composes it from `config/`, and pydantic checks it."""
