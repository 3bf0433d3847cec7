"""Benchmark: tracks whose tasks, errors and seeds are fixed, and tables of episodes."""

from magrl.benchmark.episodes import episode_table as episode_table
from magrl.benchmark.episodes import read_episodes as read_episodes
from magrl.benchmark.episodes import write_episodes as write_episodes
from magrl.benchmark.tracks import TRACKS as TRACKS
from magrl.benchmark.tracks import Track as Track
