"""Configurations as the command line composes them, in a fraction of the time: tests compose some 700."""

import copy
import functools

import pytest
import yaml
from hydra import compose, initialize_config_dir
from hydra._internal.config_repository import ConfigRepository
from omegaconf import DictConfig

from neural_sim.main import conf_directory  # which also registers the resolvers of conf/

yaml.SafeLoader = yaml.CSafeLoader  # parses several times as fast
_READ = {}
_read = ConfigRepository.load_config


def _read_once(repository, config_path):
    """Read a file of a search path once in a process; Hydra reads all of them for every composition."""
    key = (*((source.provider, source.path) for source in repository.sources), config_path)
    if key not in _READ:
        _READ[key] = _read(repository, config_path)
    return copy.deepcopy(_READ[key])


def composed(*overrides: str, file: str = "config", hydra: bool = False) -> DictConfig:
    """Compose a file of conf/ with overrides; ``hydra``: its own node, too."""
    return copy.deepcopy(_composed(overrides, file, hydra))


@functools.cache
def _composed(overrides: tuple[str, ...], file: str, hydra: bool) -> DictConfig:
    with (
        pytest.MonkeyPatch.context() as patched,
        initialize_config_dir(str(conf_directory()), version_base="1.3"),
    ):
        patched.setattr(ConfigRepository, "load_config", _read_once)
        return compose(file, list(overrides), return_hydra_config=hydra)
