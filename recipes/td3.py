"""TD3 without guidance: the paper's baseline.

    python recipes/td3.py

The same training as td3_gradient_guided.py, flags included, without the theoretical heading and its reward.
"""

from td3_gradient_guided import main

if __name__ == "__main__":
    main("td3.py", guided=False)
