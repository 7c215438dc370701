// A robot's links on its joints, as an SDF document states them.
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <ostream>
#include <stdexcept>
#include <string>
#include <vector>

#include <ignition/math/Inertial.hh>
#include <ignition/math/Pose3.hh>
#include <sdf/Joint.hh>
#include <sdf/JointAxis.hh>
#include <sdf/Link.hh>
#include <sdf/Model.hh>

namespace {

template <typename Errors>
void agreed(const Errors &errors) {
  if (!errors.empty()) throw std::runtime_error(errors.front().Message());
}

void write(std::ostream &out, const ignition::math::Vector3d &v) { out << '\t' << v.X() << '\t' << v.Y() << '\t' << v.Z(); }
void write(std::ostream &out, const ignition::math::Pose3d &pose) {
  write(out, pose.Pos());
  const auto &q = pose.Rot();
  out << '\t' << q.W() << '\t' << q.X() << '\t' << q.Y() << '\t' << q.Z();
}

// Each joint's frame in that of the joint which carries its parent (else in the world's), its axis and spring, and the link
// that it carries, with the link's centre of mass and inertia, all in the frame of the joint.
void describe_links(std::ostream &out, const ::sdf::Model &model) {
  std::map<std::string, std::string> carrier;
  std::vector<std::array<std::string, 2>> ends(model.JointCount());
  for (std::uint64_t k = 0; k < model.JointCount(); ++k) {
    const auto &joint = *model.JointByIndex(k);
    if (!joint.ResolveParentLink(ends[k][0]).empty() || !joint.ResolveChildLink(ends[k][1]).empty()) return;
    carrier[ends[k][1]] = joint.Name();
  }
  for (std::uint64_t k = 0; k < model.JointCount(); ++k) {
    const auto &joint = *model.JointByIndex(k);
    const auto &[parent, child] = ends[k];
    const auto *link = model.LinkByName(child);
    if (!link || (parent != "world" && !carrier.count(parent))) return;
    ignition::math::Pose3d place, world, own;
    agreed(joint.SemanticPose().Resolve(place, parent == "world" ? "__model__" : carrier[parent]));
    if (parent == "world") {
      agreed(model.SemanticPose().Resolve(world));
      place = world * place;
    }
    agreed(link->SemanticPose().Resolve(own, joint.Name()));
    // This version of Gazebo turns an inertia by its <pose> twice.
    const auto &stated = link->Inertial().Pose();
    const ignition::math::Pose3d centre(stated.Pos(), stated.Rot() * stated.Rot());
    const ignition::math::Inertiald inertia(link->Inertial().MassMatrix(), own * centre);
    const auto moment = inertia.Moi();
    ignition::math::Vector3d axis(0, 0, 1);
    const auto *moves = joint.Type() == ::sdf::JointType::FIXED ? nullptr : joint.Axis(0);
    if (moves) agreed(moves->ResolveXyz(axis));
    out << "carried\t" << joint.Name() << '\t' << parent << '\t' << child;
    write(out, place), write(out, axis), write(out, inertia.Pose().Pos());
    out << '\t' << moment(0, 0) << '\t' << moment(1, 1) << '\t' << moment(2, 2) << '\t' << moment(0, 1) << '\t'
        << moment(0, 2) << '\t' << moment(1, 2) << '\t' << (moves ? moves->SpringStiffness() : 0) << '\t'
        << (moves ? moves->SpringReference() : 0) << '\n';
  }
}

}  // namespace
