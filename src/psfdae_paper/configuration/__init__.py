"""Typed configuration: Hydra composes it from `config/`, pydantic checks it."""
