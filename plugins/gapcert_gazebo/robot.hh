// A robot in a world of Gazebo's physics: read from an SDF text, built, and built again with other numbers.
#pragma once

#include <array>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <iostream>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <netinet/in.h>
#include <sys/socket.h>
#include <unistd.h>

#include <Eigen/Geometry>
#include <ignition/physics/ForwardStep.hh>
#include <ignition/physics/FrameSemantics.hh>
#include <ignition/physics/FreeGroup.hh>
#include <ignition/physics/GetEntities.hh>
#include <ignition/physics/Joint.hh>
#include <ignition/physics/Link.hh>
#include <ignition/physics/PrismaticJoint.hh>
#include <ignition/physics/RequestEngine.hh>
#include <ignition/physics/RevoluteJoint.hh>
#include <ignition/physics/World.hh>
#include <ignition/physics/config.hh>
#include <ignition/physics/sdf/ConstructWorld.hh>
#include <ignition/plugin/Loader.hh>
#include <sdf/Collision.hh>
#include <sdf/Console.hh>
#include <sdf/Joint.hh>
#include <sdf/JointAxis.hh>
#include <sdf/Link.hh>
#include <sdf/Model.hh>
#include <sdf/Root.hh>
#include <sdf/World.hh>

#include "links.hh"

namespace ph = ignition::physics;
using Eigen::Vector3d;
using Features = ph::FeatureList<ph::AddLinkExternalForceTorque, ph::CollisionDetector, ph::FindFreeGroupFeature, ph::ForwardStep,
                                 ph::GetBasicJointProperties, ph::GetBasicJointState, ph::GetEntities, ph::GetPrismaticJointProperties,
                                 ph::GetRevoluteJointProperties, ph::Gravity, ph::JointFrameSemantics, ph::LinkFrameSemantics,
                                 ph::SetBasicJointState, ph::SetJointEffortLimitsFeature,
                                 ph::SetJointVelocityCommandFeature, ph::Solver,
                                 ph::sdf::ConstructSdfWorld>;
using WorldPtr = ph::World3dPtr<Features>;
using LinkPtr = ph::Link3dPtr<Features>;
using JointPtr = ph::Joint3dPtr<Features>;

namespace {

[[noreturn]] void refuse(const std::string &what) { throw std::runtime_error(what); }

// What is written to stderr while it lives: where Gazebo builds something else than the file says, it tells it there only.
class Captured {
 public:
  Captured() : file_(std::tmpfile()) {
    if (!file_) refuse("no temporary file can be written");
    std::fflush(stderr);
    old_ = dup(STDERR_FILENO);
    dup2(fileno(file_), STDERR_FILENO);
  }
  ~Captured() {
    std::fflush(stderr);
    dup2(old_, STDERR_FILENO);
    close(old_);
    std::fclose(file_);
  }

  // The errors: the profiler, which is kept from starting, is none.
  std::string errors() const {
    std::cerr.flush();
    std::fflush(stderr);
    std::string text(static_cast<std::size_t>(lseek(fileno(file_), 0, SEEK_CUR)), ' ');
    if (pread(fileno(file_), text.data(), text.size(), 0) < 0) refuse("a temporary file cannot be read");
    std::istringstream lines(text);
    std::string found;
    for (std::string line; std::getline(lines, line);)
      if (line.find("Remotery") == std::string::npos) found += line + '\n';
    return found;
  }

 private:
  std::FILE *file_;
  int old_;
};

// Debian's Gazebo opens a port for a profiler in its first step, unless it cannot have it.
class WithoutProfiler {
 public:
  WithoutProfiler() : socket_(socket(AF_INET, SOCK_STREAM, 0)) {
    sockaddr_in address{};
    address.sin_family = AF_INET;
    socklen_t size = sizeof address;
    if (bind(socket_, reinterpret_cast<sockaddr *>(&address), size) || listen(socket_, 1)) return;
    if (getsockname(socket_, reinterpret_cast<sockaddr *>(&address), &size)) return;
    setenv("RMT_PORT", std::to_string(ntohs(address.sin_port)).c_str(), 1);
  }
  ~WithoutProfiler() {
    unsetenv("RMT_PORT");
    close(socket_);
  }

 private:
  int socket_;
};

struct Motor {
  std::size_t joint;
  double yaw, yaw_rate, target;
};

struct Movable {
  JointPtr joint;
  LinkPtr parent, child;  // parent: null where it is the world
  bool turns, rated;      // rated: driven by Gazebo's own rate motor
};

// What Gazebo has built, and can be thrown away and built again.
struct Built {
  ignition::plugin::PluginPtr plugin;
  WorldPtr world;
  std::vector<Movable> joints;
  LinkPtr root;
  JointPtr base;  // null where it is joined to the world
  std::vector<double> rest;  // of the base, where it floats
  ph::ForwardStep::Input input;
  ph::ForwardStep::Output output;
  ph::ForwardStep::State state;

  void step() { world->Step(output, state, input); }
};

struct Robot {
  ::sdf::Root root;
  const ::sdf::Model *model = nullptr;
  std::string detector, solver, engine, description;
  std::int64_t nanoseconds = 0;
  bool touches = false;
  std::vector<Motor> motors;
  double gain = 0, limit = 0;
  int every = 1;
  double grip = 1;
  std::vector<std::pair<::sdf::ElementPtr, double>> grips;
  std::vector<ignition::math::Inertiald> stated;
  Built now;
};

const ::sdf::Model *find(const ::sdf::World &world, const std::string &name) {
  const ::sdf::Model *found = nullptr;
  std::string moving;
  std::size_t count = 0;
  for (std::uint64_t k = 0; k < world.ModelCount(); ++k) {
    const auto *model = world.ModelByIndex(k);
    if (name.empty() ? !model->Static() : name == model->Name()) found = model;
    if (!model->Static()) moving += (count++ ? ", " : "") + model->Name();
  }
  if (!found) refuse(name.empty() ? "it has no model that is not static" : "it has no model '" + name + "'; it has " + moving);
  if (found->Static()) refuse("its model '" + name + "' is static; expected one that moves");
  if (count > 1) refuse("its models " + moving + " can move; expected one robot, and everything else <static>");
  if (found->ModelCount()) refuse("its model '" + found->Name() + "' has models inside; expected links and joints only");
  return found;
}

const char *kind(const ::sdf::Joint &joint) {
  switch (joint.Type()) {
    case ::sdf::JointType::REVOLUTE: return "revolute";
    case ::sdf::JointType::PRISMATIC: return "prismatic";
    case ::sdf::JointType::FIXED: return "fixed";
    default: refuse("joint '" + joint.Name() + "' is neither revolute, continuous, prismatic nor fixed");
  }
}

// The document is ours and not const; only its accessors are.
template <typename T>
T &ours(const T *part) {
  return const_cast<T &>(*part);
}

// This version of Gazebo welds a joint of type continuous.
void unwind(const ::sdf::Model &model) {
  for (std::uint64_t k = 0; k < model.ModelCount(); ++k) unwind(*model.ModelByIndex(k));
  for (std::uint64_t k = 0; k < model.JointCount(); ++k) {
    auto &joint = ours(model.JointByIndex(k));
    if (joint.Type() == ::sdf::JointType::CONTINUOUS) joint.SetType(::sdf::JointType::REVOLUTE);
    if (kind(joint) != std::string("fixed") && !joint.Axis(0)) refuse("joint '" + joint.Name() + "' has no axis");
  }
}

std::uint64_t shapes(const ::sdf::Model &model) {
  std::uint64_t count = 0;
  for (std::uint64_t k = 0; k < model.LinkCount(); ++k) count += model.LinkByIndex(k)->CollisionCount();
  for (std::uint64_t k = 0; k < model.ModelCount(); ++k) count += shapes(*model.ModelByIndex(k));
  return count;
}

bool touches(const ::sdf::World &world, const ::sdf::Model &model) {
  const auto own = shapes(model);
  std::uint64_t all = 0;
  for (std::uint64_t k = 0; k < world.ModelCount(); ++k) all += shapes(*world.ModelByIndex(k));
  return own && (all > own || (model.SelfCollide() && own > 1));
}

// The friction coefficients of every shape, as the file states them.
void find_grips(const ::sdf::Model &model, std::vector<std::pair<::sdf::ElementPtr, double>> &grips) {
  for (std::uint64_t k = 0; k < model.LinkCount(); ++k) {
    const auto &link = *model.LinkByIndex(k);
    for (std::uint64_t c = 0; c < link.CollisionCount(); ++c) {
      auto friction = link.CollisionByIndex(c)->Element()->GetElement("surface")->GetElement("friction")->GetElement("ode");
      for (const std::string name : {"mu", "mu2"}) {
        // Asking for an element makes one; where mu2 is not given, mu holds in both directions.
        if (name == "mu2" && !friction->HasElement(name)) continue;
        auto grip = friction->GetElement(name);
        grips.emplace_back(grip, grip->Get<double>());
      }
    }
  }
  for (std::uint64_t k = 0; k < model.ModelCount(); ++k) find_grips(*model.ModelByIndex(k), grips);
}

void describe(Robot &robot) {
  std::ostringstream out;
  out.precision(17);
  out << "model\t" << robot.model->Name() << '\n';
  for (std::uint64_t k = 0; k < robot.model->JointCount(); ++k) {
    const auto &joint = *robot.model->JointByIndex(k);
    const auto *axis = joint.Axis(0);
    const bool limited = axis && (axis->Lower() > -1e15 || axis->Upper() < 1e15), bounded = axis && std::isfinite(axis->Effort());
    out << "joint\t" << joint.Name() << '\t' << kind(joint) << '\t' << (axis ? axis->Damping() : 0) << '\t'
        << (axis ? axis->Friction() : 0) << '\t' << limited << '\t' << bounded;
    const std::array<double, 4> ends = axis ? std::array{axis->Lower(), axis->Upper(), axis->MaxVelocity(), axis->Effort()}
                                            : std::array{-1e16, 1e16, 1e16, 1e16};
    for (const double end : ends) out << '\t' << end;
    out << '\n';
  }
  for (std::uint64_t k = 0; k < robot.model->LinkCount(); ++k) {
    const auto &link = *robot.model->LinkByIndex(k);
    robot.stated.push_back(link.Inertial());
    out << "link\t" << link.Name() << '\t' << link.Inertial().MassMatrix().Mass() << '\n';
  }
  describe_links(out, *robot.model);
  const auto g = robot.root.WorldByIndex(0)->Gravity();
  robot.touches = touches(*robot.root.WorldByIndex(0), *robot.model);
  out << "touches\t" << robot.touches << '\n';
  out << "gravity\t" << g.X() << '\t' << g.Y() << '\t' << g.Z() << '\n';
  robot.description = out.str();
}

void add_joints(Built &built, const ph::Model3dPtr<Features> &model, const ::sdf::Model &sdf) {
  for (std::uint64_t k = 0; k < sdf.JointCount(); ++k) {
    const auto &joint = *sdf.JointByIndex(k);
    const std::string type = kind(joint);
    if (type == "fixed") continue;
    std::string parent, child;
    if (!joint.ResolveParentLink(parent).empty() || !joint.ResolveChildLink(child).empty())
      refuse("the links of joint '" + joint.Name() + "' are not in the model");
    auto found = model->GetJoint(joint.Name());
    if (!found || found->GetDegreesOfFreedom() != 1) refuse("Gazebo did not build joint '" + joint.Name() + "'");
    const auto above = parent == "world" ? LinkPtr() : model->GetLink(parent);
    built.joints.push_back({found, above, model->GetLink(child), type == "revolute", false});
  }
}

void find_base(Built &built, const ph::Model3dPtr<Features> &model, const ::sdf::Model &sdf) {
  std::uint64_t free = 0;
  for (std::uint64_t k = 0; k < sdf.LinkCount(); ++k) {
    auto link = model->GetLink(sdf.LinkByIndex(k)->Name());
    auto group = link->FindFreeGroup();
    free += bool(group);
    // A group's own link has no name in this version of Gazebo, only an id.
    if (!group || group->EntityID() != link->EntityID()) continue;
    if (built.base) refuse("links '" + built.root->GetName() + "' and '" + link->GetName() + "' are not connected; join them");
    built.root = link, built.base = model->GetJoint(link->GetName() + "_FreeJoint");
    if (!built.base || built.base->GetDegreesOfFreedom() != 6) refuse("link '" + link->GetName() + "' does not float freely");
  }
  if (free && free < sdf.LinkCount()) refuse("some of its links are fixed to the world and some are not; join them");
}

void read_base(const Built &built, double *base) {
  const auto data = built.root->FrameDataRelativeToWorld();
  const Eigen::Quaterniond q(data.pose.linear());
  const double sign = q.w() < 0 ? -1 : 1;
  const double rotation[4] = {sign * q.w(), sign * q.x(), sign * q.y(), sign * q.z()};
  const Vector3d place = data.pose.translation();
  std::memcpy(base, place.data(), sizeof(double[3]));
  std::memcpy(base + 3, rotation, sizeof rotation);
  std::memcpy(base + 7, data.linearVelocity.data(), sizeof(double[3]));
  std::memcpy(base + 10, data.angularVelocity.data(), sizeof(double[3]));
}

void arm(Robot &robot) {
  for (const auto &motor : robot.motors) {
    auto &m = robot.now.joints.at(motor.joint);
    m.rated = robot.gain == 0;
    if (m.rated && std::isfinite(robot.limit)) m.joint->SetMinEffort(0, -robot.limit), m.joint->SetMaxEffort(0, robot.limit);
  }
}

void start(Built &built, std::int64_t nanoseconds) {
  // Gazebo ignores a time step that differs by less than 1 µs from the one it has.
  for (std::int64_t extra : {1000000, 0}) {
    built.input.Get<std::chrono::steady_clock::duration>() = std::chrono::nanoseconds(nanoseconds + extra);
    built.step();
  }
}

void construct(Robot &robot) {
  const Captured complaints;
  const WithoutProfiler port;
  static ignition::plugin::Loader loader;
  static const auto names = loader.LoadLib(IGNITION_PHYSICS_ENGINE_INSTALL_DIR "/libignition-physics5-dartsim-plugin.so.5");
  Built built;
  built.plugin = loader.Instantiate("ignition::physics::dartsim::Plugin");
  auto engine = ph::RequestEngine3d<Features>::From(built.plugin);
  if (!engine) refuse("Gazebo's physics cannot be loaded, or lacks a feature: " + complaints.errors());
  built.world = engine->ConstructWorld(*robot.root.WorldByIndex(0));
  if (complaints.errors().empty()) {
    if (!robot.detector.empty()) built.world->SetCollisionDetector(robot.detector);
    if (!robot.solver.empty()) built.world->SetSolver(robot.solver);
    robot.detector = built.world->GetCollisionDetector();
    auto model = built.world->GetModel(robot.model->Name());
    if (!model) refuse("Gazebo did not build model '" + robot.model->Name() + "'");
    add_joints(built, model, *robot.model);
    find_base(built, model, *robot.model);
    if (built.base) read_base(built, (built.rest.resize(13), built.rest.data()));
    start(built, robot.nanoseconds);
  }
  if (!complaints.errors().empty()) refuse(complaints.errors());
  robot.engine = engine->GetName();
  robot.now = std::move(built);
  arm(robot);
}

std::unique_ptr<Robot> open(const char *text, const char *name, const char *detector, const char *solver, std::int64_t nanoseconds) {
  ::sdf::Console::Instance()->SetQuiet(true);
  auto robot = std::make_unique<Robot>();
  std::string problems;
  for (const auto &error : robot->root.LoadSdfString(text)) problems += (problems.empty() ? "" : "; ") + error.Message();
  if (!problems.empty()) refuse(problems);
  if (robot->root.WorldCount() != 1) refuse("it has " + std::to_string(robot->root.WorldCount()) + " worlds; expected one");
  robot->model = find(*robot->root.WorldByIndex(0), name);
  robot->detector = detector, robot->solver = solver, robot->nanoseconds = nanoseconds;
  const auto &world = *robot->root.WorldByIndex(0);
  for (std::uint64_t k = 0; k < world.ModelCount(); ++k) {
    unwind(*world.ModelByIndex(k));
    find_grips(*world.ModelByIndex(k), robot->grips);
  }
  describe(*robot);
  construct(*robot);
  std::ostringstream out;
  out.precision(17);
  for (double number : robot->now.rest) out << '\t' << number;
  if (robot->now.base) robot->description += "base" + out.str() + '\n';
  robot->description += "engine\t" + robot->engine + '\n';
  return robot;
}

// values: gravity (3), damping and friction of each movable joint, mass of each link (its inertia in
// proportion), and a factor on the friction of all shapes.
void set(Robot &robot, const double *values) {
  std::size_t at = 3;
  bool changed = false;
  for (std::uint64_t k = 0; k < robot.model->JointCount(); ++k) {
    auto &joint = ours(robot.model->JointByIndex(k));
    if (joint.Type() == ::sdf::JointType::FIXED) continue;
    auto axis = *joint.Axis(0);
    changed |= axis.Damping() != values[at] || axis.Friction() != values[at + 1];
    axis.SetDamping(values[at++]), axis.SetFriction(values[at++]);
    joint.SetAxis(0, axis);
  }
  for (std::uint64_t k = 0; k < robot.model->LinkCount(); ++k) {
    auto &link = ours(robot.model->LinkByIndex(k));
    changed |= link.Inertial().MassMatrix().Mass() != values[at];
    auto inertial = robot.stated[k];
    auto matrix = inertial.MassMatrix();
    matrix.SetMoi(matrix.Moi() * (values[at] / matrix.Mass()));
    matrix.SetMass(values[at++]);
    inertial.SetMassMatrix(matrix);
    link.SetInertial(inertial);
  }
  changed |= robot.grip != values[at];
  robot.grip = values[at];
  for (auto &[element, stated] : robot.grips) element->Set(stated * robot.grip);
  if (changed) construct(robot);
  robot.now.world->SetGravity(ph::RelativeForce3d(ph::FrameID::World(), Vector3d(values[0], values[1], values[2])));
}

}  // namespace
