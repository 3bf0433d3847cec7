"""Benchmark: frozen tracks, results as data, and submissions that can be verified."""

from magrl.benchmark.episodes import episode_table as episode_table
from magrl.benchmark.episodes import read_episodes as read_episodes
from magrl.benchmark.episodes import write_episodes as write_episodes
from magrl.benchmark.submission import Submission as Submission
from magrl.benchmark.submission import run as run
from magrl.benchmark.submission import verify as verify
from magrl.benchmark.tracks import TRACKS as TRACKS
from magrl.benchmark.tracks import Track as Track
