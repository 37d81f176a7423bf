"""The contract of lidardesign's tasks, one test per law."""


def test_the_task_keeps_the_contract(task_law):
    task_law.check()
