"""TorchRL's configured trainers with our environment and a memory: ``ppo.yaml`` and ``dqn.yaml``
name every part by ``_target_``, and the command line changes any of it.

    python examples/torchrl_config/train.py --config-name dqn memory=lru seed=3

Needs Hydra (``pip install hydra-core``).
"""

import hydra
from hydra.utils import instantiate
from omegaconf import DictConfig
from torchrl.trainers import Trainer
from torchrl.trainers.algorithms import configs

__all__ = ["configs", "make_trainer"]  # the import of configs is what registers TorchRL's groups


def make_trainer(config: DictConfig) -> Trainer:
    """The trainer of a config. Collector, advantages and loss share one network, which YAML cannot
    say: every mention of a node there makes a new one, with other weights.
    """
    agent = instantiate(config.agent)
    if "value_network" in config.trainer:
        return instantiate(config.trainer, value_network=agent)
    policy = agent.get_policy_operator()
    critic = agent.get_value_operator()
    return instantiate(
        config.trainer,
        collector={"policy": policy},
        gae={"critic": critic},
        loss_module={"actor_network": policy, "critic_network": critic},
    )


@hydra.main(version_base=None, config_path=".", config_name="ppo")
def main(config: DictConfig) -> None:
    """Train."""
    make_trainer(config).train()


if __name__ == "__main__":
    main()
