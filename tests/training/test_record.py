"""The log of a training: what a resumed training keeps of it, and logs that are none."""

import pytest

from jaxsr.errors import JaxsrError
from jaxsr.training.record import Log


def test_rows_after_the_checkpoint_are_dropped(tmp_path):
    log = Log(tmp_path, 0)
    for step in (1, 2, 3):
        log.add({"step": step, "loss": 1.0 / step} | ({"psnr": 20.0} if step == 2 else {}))
    log.close()
    assert (tmp_path / "log.csv").read_text().splitlines()[1:3] == ["1,1.0,", "2,0.5,20.0"]
    with (tmp_path / "log.csv").open("a") as file:
        file.write("4,0.2")  # the writer was killed inside the line
    again = Log(tmp_path, 2)
    again.close()
    assert [row["step"] for row in again.rows] == [1, 2]
    assert (tmp_path / "log.csv").read_text() == "step,loss,psnr\n1,1.0,\n2,0.5,20.0\n"


@pytest.mark.parametrize(
    "content",
    [
        b"a,b\nc,d\n",
        b"step,loss\n1e999,0.5\n",
        b"step,loss\nnan,0.5\n",
        b"step,loss\n1,0.5,7\n",
        b"\xff\xfe\x00\n\n",
        b"step,loss\n1," + b"9" * 200_000 + b"x\n",
        b"step,loss\n" + b'"' + b"x" * 200_000 + b'",1\n',
    ],
)
def test_what_is_no_log(tmp_path, content):
    (tmp_path / "log.csv").write_bytes(content)
    with pytest.raises(JaxsrError, match=r"log\.csv: not the log of a training") as caught:
        Log(tmp_path, 5)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000
