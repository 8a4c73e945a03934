"""Small networks of random weights, saved as the hub's models are, and photographs to ask them about."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import nn

IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
SAM_SIDE = 64


def photograph(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Smooth colours, edges and fine noise, as in a photograph."""
    random = np.random.default_rng(seed)
    image = cv2.resize(random.uniform(0, 255, (5, 7, 3)).astype(np.float32), (width, height))
    for _ in range(6):
        x, y = random.integers(0, width), random.integers(0, height)
        w, h = random.integers(4, max(5, width // 2)), random.integers(4, max(5, height // 2))
        colour = random.uniform(0, 255, 3)
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), tuple(map(float, colour)), -1)
    return np.clip(image + random.normal(0, 6, image.shape), 0, 255).astype(np.uint8)


def shake(network: nn.Module, std: float = 0.3) -> nn.Module:
    """Weights large enough that the answer depends on everything."""
    torch.manual_seed(2)
    for name, parameter in network.named_parameters():
        nn.init.normal_(parameter, std=std)
        if name.endswith("bias"):  # else masks are all or nothing
            nn.init.zeros_(parameter)
    return network.eval()


def save_processor(folder: Path, **config: Any) -> None:
    (folder / "preprocessor_config.json").write_text(json.dumps({"do_resize": True, "do_rescale": True, **config}))


def save_dfine(
    folder: Path, names: tuple[str, ...] = ("person", "car", "truck", "bus"), queries: int = 20
) -> nn.Module:
    """A small D-FINE: independent probabilities, sides fixed to 64 px, no normalisation."""
    from transformers import DFineConfig, DFineForObjectDetection, HGNetV2Config

    backbone = HGNetV2Config(
        stem_channels=[3, 8, 8],
        hidden_sizes=[16] * 4,
        stage_in_channels=[8, 16, 16, 16],
        stage_mid_channels=[8] * 4,
        stage_out_channels=[16] * 4,
        stage_num_blocks=[1] * 4,
        stage_downsample=[False, True, True, True],
        stage_light_block=[False, False, True, True],
        stage_kernel_size=[3, 3, 5, 5],
        stage_numb_of_layers=[1] * 4,
        embeddings_size=16,
        depths=[1] * 4,
        out_features=["stage2", "stage3", "stage4"],
        return_idx=[1, 2, 3],
    )
    config = DFineConfig(
        backbone_config=backbone,
        id2label=dict(enumerate(names)),
        encoder_hidden_dim=16,
        encoder_in_channels=[16] * 3,
        encoder_ffn_dim=16,
        encoder_attention_heads=2,
        encoder_layers=1,
        d_model=16,
        decoder_in_channels=[16] * 3,
        decoder_ffn_dim=16,
        decoder_attention_heads=2,
        decoder_layers=2,
        num_queries=queries,
        hidden_expansion=0.5,
        depth_mult=0.34,
    )
    network = shake(DFineForObjectDetection(config), std=0.2)
    network.save_pretrained(folder)
    save_processor(folder, do_normalize=False, do_pad=False, size={"height": 64, "width": 64}, **IMAGENET)
    return network


def save_yolos(folder: Path, names: tuple[str, ...] = ("N/A", "person", "car", "truck")) -> nn.Module:
    """A small YOLOS: softmax with "no object", aspect ratio kept, an old form of the sizes."""
    from transformers import YolosConfig, YolosForObjectDetection

    config = YolosConfig(
        id2label=dict(enumerate(names)),
        hidden_size=16,
        num_hidden_layers=2,
        num_attention_heads=2,
        intermediate_size=16,
        image_size=[64, 96],
        patch_size=16,
        num_detection_tokens=20,
    )
    network = shake(YolosForObjectDetection(config), std=0.4)
    network.save_pretrained(folder)
    save_processor(folder, do_normalize=True, size=64, max_size=110, **IMAGENET)
    return network


def save_sam(folder: Path) -> nn.Module:
    from transformers import SamConfig, SamModel

    config = SamConfig(
        vision_config={
            "hidden_size": 16,
            "output_channels": 16,
            "num_hidden_layers": 2,
            "num_attention_heads": 2,
            "image_size": SAM_SIDE,
            "patch_size": 8,
            "window_size": 4,
            "global_attn_indexes": [1],
            "num_pos_feats": 8,
            "mlp_dim": 16,
        },
        prompt_encoder_config={
            "hidden_size": 16,
            "image_size": SAM_SIDE,
            "patch_size": 8,
            "mask_input_channels": 4,
        },
        mask_decoder_config={"hidden_size": 16, "mlp_dim": 16, "num_attention_heads": 2, "iou_head_hidden_dim": 16},
    )
    network = shake(SamModel(config))
    last = network.mask_decoder.iou_prediction_head.proj_out
    with torch.no_grad():  # predicted IoUs between 0 and 1
        last.weight *= 0.02
        last.bias.copy_(torch.linspace(0.4, 0.6, len(last.bias)))
    network.save_pretrained(folder)
    pad = {"height": SAM_SIDE, "width": SAM_SIDE}
    save_processor(folder, do_normalize=True, do_pad=True, pad_size=pad, size={"longest_edge": SAM_SIDE}, **IMAGENET)
    return network


def save_sam2(folder: Path, is_video: bool = False) -> nn.Module:
    """`is_video`: as the hub has them, the video model, whose memory is of no use for photographs."""
    from transformers import Sam2Config, Sam2Model, Sam2VideoConfig, Sam2VideoModel

    parts: dict[str, Any] = {
        "vision_config": {
            "model_type": "sam2_vision_model",
            "backbone_config": {
                "model_type": "sam2_hiera_det_model",
                "hidden_size": 8,
                "image_size": [SAM_SIDE, SAM_SIDE],
                "num_attention_heads": 1,
                "embed_dim_per_stage": [8, 16, 32, 64],
                "num_attention_heads_per_stage": [1, 1, 2, 2],
                "blocks_per_stage": [1, 1, 2, 1],
                "window_size_per_stage": [4, 2, 2, 2],
                "global_attention_blocks": [3],
                "window_positional_embedding_background_size": [4, 4],
            },
            "backbone_channel_list": [64, 32, 16, 8],
            "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
            "fpn_hidden_size": 32,
        },
        "prompt_encoder_config": {
            "hidden_size": 32,
            "image_size": SAM_SIDE,
            "patch_size": 16,
            "mask_input_channels": 4,
        },
        "mask_decoder_config": {"hidden_size": 32, "mlp_dim": 16, "num_attention_heads": 2, "iou_head_hidden_dim": 16},
    }
    memory = {
        "image_size": SAM_SIDE,
        "memory_attention_hidden_size": 32,
        "memory_attention_feed_forward_hidden_size": 16,
        "memory_attention_num_layers": 1,
        "memory_encoder_hidden_size": 32,
        "memory_encoder_output_channels": 8,
        "mask_downsampler_embed_dim": 32,
        "memory_fuser_embed_dim": 32,
        "memory_fuser_intermediate_dim": 32,
    }
    network = shake(Sam2VideoModel(Sam2VideoConfig(**parts, **memory)) if is_video else Sam2Model(Sam2Config(**parts)))
    network.save_pretrained(folder)
    save_processor(folder, do_normalize=True, size={"height": SAM_SIDE, "width": SAM_SIDE}, **IMAGENET)
    return network
