from pathlib import Path

import pytest

from nerfdiff.cli import load_config, prepare_arguments
from nerfdiff.quoting import gather_lists, parse_override, quote_values
from nerfdiff.utils.errors import ConfigError

NAMES = ["photo (1).png", "été.png", "日本.png", "car~1.png", "a=b.png", "it's.png", "car#2.png", "[a](1).png", "2024",
         "'a'.png", 'say "x".png', "a;b&c!.png", "(1).png", "50% off.png", "1e3", "true", "x\\"]  # fmt: skip


def read(word: str) -> object:
    (quoted,) = quote_values([word])
    assert quote_values([quoted]) == [quoted]  # processes that are started anew get what is quoted already
    return parse_override(quoted).value()


@pytest.mark.parametrize("name", [*NAMES, "plain.png", "/a/b-c_d.png", "C:/x"])
@pytest.mark.parametrize("key", ["image", "data.root", "+picture.mask", "hydra.run.dir"])
def test_a_path_is_taken_as_it_is_typed(name, key):
    assert read(f"{key}={name}") == name
    assert read(f"{key} = {name}") == name


@pytest.mark.parametrize("name", ["a,b.png", "[a]", "choice(1)", "{a:1}", "null", "a (1),b"])
def test_what_hydra_has_a_meaning_for_is_a_path_where_such_a_file_is(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert read(f"image={name}") != name
    Path(name).touch()
    assert read(f"image={name}") == name
    assert quote_values([f"seed={name}"]) == [f"seed={name}"] or name == "a (1),b"


def test_home_is_expanded(monkeypatch):
    monkeypatch.setenv("HOME", "/home/my name")
    assert read("data.root=~/data") == "/home/my name/data" and read("data.root=~") == "/home/my name"
    assert read("ckpt='~/a (1)'") == "/home/my name/a (1)"
    assert read("results=[~/a,b (1),'c, d']") == ["/home/my name/a", "b (1)", "c, d"]
    (sweep,) = quote_values(["ckpt=~/a,b (1),plain,2024"])
    choices = parse_override(sweep).sweep_string_iterator()
    assert [read(f"ckpt={choice}") for choice in choices] == ["/home/my name/a", "b (1)", "plain", "2024"]


@pytest.mark.parametrize(
    "word",
    ["seed=1,2", "seed=2024", "optimizer.lr=1e-3", "image=null", "model=tiny,base", "~logger=tensorboard", "~logger",
     "-m", "--config-dir=a b", "data.image_size=[32, 64]", "optimizer.lr=interval(0,1)", "seed=range(1,4)", "ckpt=",
     "ckpt=a,b", "ckpt=glob(*)", "paths.runs_dir=${oc.env:HOME}/runs", "model.unet={width: 64}", "image='a b.png'",
     "image=a\\ b.png", "splits={train:[0,500]}"],
)  # fmt: skip
def test_what_hydra_reads_as_meant_is_left_alone(word):
    assert quote_values([word]) == [word]


def test_configs_composed_in_python_take_paths_too():
    assert load_config("make_scenes", ["root=my data (1)"]).root == "my data (1)"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["splits={a:é}"], "cannot read the override splits={a:é}; if its value is text, quote all of it: "),
        (["seed=[1,2"], r"""'seed="[1,2"'"""),
        (["ckpt=demo", "car.png"], "car.png says no key: write key=car.png"),
        (["image=", "car.png"], "car.png says no key"),
    ],
)
def test_what_cannot_be_read_is_named_with_how_to_write_it(words, message):
    with pytest.raises(ConfigError) as error:
        prepare_arguments("distill", [], words)
    assert message in str(error.value)


def listed(command: str, *words: str) -> dict[str, list]:
    gathered = [parse_override(word) for word in quote_values(gather_lists(command, list(words)))]
    return {override.key_or_group: override.value() for override in gathered}


def test_lists_are_written_with_commas_and_are_no_sweeps(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in (*NAMES, "a,b.safetensors"):
        Path(name).touch()
        assert listed("export", f"field={name}", "format=glb,ply") == {"fields": [name], "format": ["glb", "ply"]}
    assert listed("export", "field=x.safetensors,y z.safetensors") == {"fields": ["x.safetensors", "y z.safetensors"]}
    assert listed("view", "fields=a/x.safetensors") == {"fields": ["a/x.safetensors"]}
    assert listed("export", "fields=x,y") == listed("export", "fields=[x,y]") == {"fields": ["x", "y"]}
    box = {"images": ["a.jpg"], "box": [100, 100.5, 2000, 2000]}
    assert listed("picture", "a.jpg", "box=100,100.5,2000,2000") == box
    assert listed("picture", "a.jpg", "box=[100,100.5,2000,2000]") == box
    assert listed("export", "field=[x,y]", "format=[glb]") == {"fields": ["x", "y"], "format": ["glb"]}
    assert listed("picture", *NAMES, "elevation=8") == {"images": NAMES, "elevation": 8}
    assert listed("picture", "image=a.jpg,b.jpg") == {"images": ["a.jpg", "b.jpg"]}
    assert gather_lists("train", ["field=triplane,pixelnerf", "-m"]) == ["field=triplane,pixelnerf", "-m"]
    assert load_config("export", ["format=ply"]).format == ["ply"]
