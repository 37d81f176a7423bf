"""The contracts of lidardesign's plugins, one test per law; of the task with boxes at rest and driving."""


def test_the_task(task_law):
    task_law.check()


def test_the_method(method_law):
    method_law.check()


def test_the_format(format_law):
    format_law.check()
